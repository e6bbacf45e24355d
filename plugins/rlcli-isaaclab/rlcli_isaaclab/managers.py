"""Configurations of terms, and what a term's own code is written with. Names as in `isaaclab.managers`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rlcli_isaaclab.config_class import MISSING, configclass


@configclass
class SceneEntityCfg:
    """Elements of one entity; when a term is bound, `joint_ids` and `body_ids` are what the names resolve to."""

    name: str = MISSING
    joint_names: Any = None
    joint_ids: Any = slice(None)
    body_names: Any = None
    body_ids: Any = slice(None)
    fixed_tendon_names: Any = None
    fixed_tendon_ids: Any = slice(None)
    object_collection_names: Any = None
    object_collection_ids: Any = slice(None)
    site_names: Any = None
    """Sites of the MJCF, for terms that Isaac Lab gives a frame transformer."""
    sensor_names: Any = None
    """Sensors of the MJCF, for terms that Isaac Lab gives an IMU."""
    preserve_order: bool = False

    def resolve(self, scene: Any) -> None:
        """Look the names up in a scene."""
        scene.resolve(self)


@configclass
class ManagerTermBaseCfg:
    """What all terms have."""

    func: Any = MISSING
    params: dict[str, Any] = {}  # noqa: RUF012  (every object gets its own)


@configclass
class ObservationTermCfg(ManagerTermBaseCfg):
    """An observation."""

    modifiers: Any = None
    noise: Any = None
    clip: Any = None
    scale: Any = None
    history_length: int = 0
    flatten_history_dim: bool = True


@configclass
class ObservationGroupCfg:
    """A group of observations; its further members are terms."""

    concatenate_terms: bool = True
    concatenate_dim: int = -1
    enable_corruption: bool = False
    history_length: Any = None
    flatten_history_dim: bool = True


@configclass
class RewardTermCfg(ManagerTermBaseCfg):
    """A reward."""

    weight: float = MISSING


@configclass
class TerminationTermCfg(ManagerTermBaseCfg):
    """A termination."""

    time_out: bool = False


@configclass
class EventTermCfg(ManagerTermBaseCfg):
    """An event."""

    mode: str = MISSING
    interval_range_s: Any = None
    is_global_time: bool = False
    min_step_count_between_reset: int = 0


@configclass
class CurriculumTermCfg(ManagerTermBaseCfg):
    """A curriculum."""


@configclass
class RecorderTermCfg:
    """A recorder; `rlcli eval --record` takes its place."""

    class_type: Any = MISSING


@configclass
class ActionTermCfg:
    """An action; the ones there are stand in `mdp`."""

    class_type: Any = MISSING
    asset_name: str = MISSING
    debug_vis: bool = False
    clip: Any = None


@configclass
class CommandTermCfg:
    """A command; the ones there are stand in `mdp`."""

    class_type: Any = MISSING
    resampling_time_range: Any = MISSING
    debug_vis: bool = False


class ManagerTermBase:
    """A term with a memory: made once with its configuration, then called with the environment and its parameters."""

    def __init__(self, cfg: Any, env: Any) -> None:
        self.cfg = cfg
        self._env = env

    @property
    def num_envs(self) -> int:
        """Environments."""
        return self._env.num_envs

    @property
    def device(self) -> Any:
        """Where tensors live."""
        return self._env.device

    def reset(self, env_ids: Any = None) -> Any:
        """Called when episodes begin."""

    def __call__(self, env: Any, *args: Any, **params: Any) -> Any:
        """The term's value."""
        raise NotImplementedError


class CommandTerm(ManagerTermBase):
    """A command of the user's own; when to draw anew is kept by the environment."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        self.metrics: dict[str, Tensor] = {}
        self.command_counter = torch.zeros(env.num_envs, dtype=torch.long, device=env.device)

    @property
    def command(self) -> Tensor:
        """What is asked. (num_envs, k)"""
        raise NotImplementedError

    def reset(self, env_ids: Any = None) -> dict[str, float]:
        """Episodes begin; the environment draws their first command after this."""
        rows = slice(None) if env_ids is None else env_ids
        self.command_counter[rows] = 0
        for metric in self.metrics.values():
            metric[rows] = 0.0
        return {}

    def set_debug_vis(self, debug_vis: bool) -> bool:
        """Nothing is drawn."""
        return False

    def _update_metrics(self) -> None:
        """Called once a step, before anything is drawn anew."""

    def _resample_command(self, env_ids: Any) -> None:
        """Draw new commands for some environments."""
        raise NotImplementedError

    def _update_command(self) -> None:
        """Called once a step, after the drawing."""


ObsTerm, ObsGroup, RewTerm, DoneTerm, EventTerm, CurrTerm = (
    ObservationTermCfg, ObservationGroupCfg, RewardTermCfg, TerminationTermCfg, EventTermCfg, CurriculumTermCfg,
)  # fmt: skip

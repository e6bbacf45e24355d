"""Configuration classes of terms, and base classes for the user's own terms.

A task of Isaac Lab that imports a name from `isaaclab.managers` gets the object of this name from here.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rlcli_isaaclab.config_class import MISSING, configclass


@configclass
class SceneEntityCfg:
    """Selection of elements of one entity, as a parameter of a term.

    When the environment is built, the names are resolved to `joint_ids` and `body_ids`.
    """

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
    """Names of sites of the MJCF, for terms that read a frame transformer in Isaac Lab."""
    sensor_names: Any = None
    """Names of sensors of the MJCF, for terms that read an IMU in Isaac Lab."""
    preserve_order: bool = False

    def resolve(self, scene: Any) -> None:
        """Set `joint_ids`, `body_ids` and the other indices from the names, in the scene of an environment."""
        scene.resolve(self)


@configclass
class ManagerTermBaseCfg:
    """Base of the configuration classes of all terms."""

    func: Any = MISSING
    params: dict[str, Any] = {}  # noqa: RUF012  (configclass copies it for each object)


@configclass
class ObservationTermCfg(ManagerTermBaseCfg):
    """Configuration of an observation term: a function, its parameters, noise, clip, scale and history."""

    modifiers: Any = None
    noise: Any = None
    clip: Any = None
    scale: Any = None
    history_length: int = 0
    flatten_history_dim: bool = True


@configclass
class ObservationGroupCfg:
    """Configuration of an observation group; its other members are terms."""

    concatenate_terms: bool = True
    concatenate_dim: int = -1
    enable_corruption: bool = False
    history_length: Any = None
    flatten_history_dim: bool = True


@configclass
class RewardTermCfg(ManagerTermBaseCfg):
    """Configuration of a reward term: a function, its parameters and its weight."""

    weight: float = MISSING


@configclass
class TerminationTermCfg(ManagerTermBaseCfg):
    """Configuration of a termination term; with `time_out` the episode is truncated, not terminated."""

    time_out: bool = False


@configclass
class EventTermCfg(ManagerTermBaseCfg):
    """Configuration of an event term: a function for startup, resets or intervals, with its parameters."""

    mode: str = MISSING
    interval_range_s: Any = None
    is_global_time: bool = False
    min_step_count_between_reset: int = 0


@configclass
class CurriculumTermCfg(ManagerTermBaseCfg):
    """Configuration of a curriculum term: a function and its parameters."""


@configclass
class RecorderTermCfg:
    """Configuration of a recorder, which has no effect; use `rlcli eval --record` instead."""

    class_type: Any = MISSING


@configclass
class ActionTermCfg:
    """Base configuration of an action term; its subclasses are in `mdp`."""

    class_type: Any = MISSING
    asset_name: str = MISSING
    debug_vis: bool = False
    clip: Any = None


@configclass
class CommandTermCfg:
    """Base configuration of a command term, a goal for the policy; its subclasses are in `mdp`."""

    class_type: Any = MISSING
    resampling_time_range: Any = MISSING
    debug_vis: bool = False


class ManagerTermBase:
    """Base class of terms with a state, created as `Name(cfg, env)` and called as `term(env, **parameters)`."""

    def __init__(self, cfg: Any, env: Any) -> None:
        self.cfg = cfg
        self._env = env

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self._env.num_envs

    @property
    def device(self) -> Any:
        """Device of the tensors."""
        return self._env.device

    def reset(self, env_ids: Any = None) -> Any:
        """Reset the state of environments (None: all) at the start of their episodes."""

    def __call__(self, env: Any, *args: Any, **params: Any) -> Any:
        """Return the term's value in all environments, (num_envs,) or (num_envs, k); None for events."""
        raise NotImplementedError


class ActionTerm(ManagerTermBase):
    """Base class of the user's own actions.

    `process_actions` is called once per environment step, `apply_actions` before each physics step.
    """

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        self._asset = env.scene[cfg.asset_name]

    @property
    def action_dim(self) -> int:
        """Number of columns of the policy's action."""
        raise NotImplementedError(f"class {type(self).__name__} has no property action_dim; implement it")

    @property
    def raw_actions(self) -> Tensor:
        """The policy's action for this term. (num_envs, k)"""
        raise NotImplementedError(f"class {type(self).__name__} has no property raw_actions; implement it")

    @property
    def processed_actions(self) -> Tensor:
        """The action after scale, offset and clip. (num_envs, k)"""
        raise NotImplementedError(f"class {type(self).__name__} has no property processed_actions; implement it")

    def process_actions(self, actions: Tensor) -> None:
        """Store or process the action, once per step. (num_envs, k)"""
        raise NotImplementedError(f"class {type(self).__name__} has no method process_actions; implement it")

    def apply_actions(self) -> None:
        """Write targets to the assets, before each physics step."""
        raise NotImplementedError(f"class {type(self).__name__} has no method apply_actions; implement it")

    def set_debug_vis(self, debug_vis: bool) -> bool:
        """Do nothing, because actions are not drawn; return False."""
        return False


class CommandTerm(ManagerTermBase):
    """Base class of the user's own commands. The environment decides when new commands are sampled."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        self.metrics: dict[str, Tensor] = {}
        self.command_counter = torch.zeros(env.num_envs, dtype=torch.long, device=env.device)
        self.time_left = torch.zeros(env.num_envs, device=env.device)
        """Time until the next resampling. (num_envs,) [s]"""

    rlcli_timer: Any = None
    """Function that updates the metrics of new episodes, and resamples the commands whose time is over."""
    rlcli_draws_time = False
    """Whether rlcli itself draws `time_left` of the commands that are sampled now."""

    @property
    def command(self) -> Tensor:
        """Current command. (num_envs, k)"""
        raise NotImplementedError

    def reset(self, env_ids: Any = None) -> dict[str, Any]:
        """Reset the counter and the metrics, and sample the first command of an episode; return the last metrics."""
        rows = torch.arange(self.num_envs, device=self.device) if env_ids is None else env_ids
        means = {name: torch.mean(metric[rows].float()) for name, metric in self.metrics.items()}
        for metric in self.metrics.values():
            metric[rows] = 0.0
        self.command_counter[rows] = 0
        self._resample(rows)
        return means

    def compute(self, dt: float) -> None:
        """Count a step of `dt` [s], resample the commands whose time is over, and update all commands."""
        self.rlcli_timer()
        self._update_command()

    def set_debug_vis(self, debug_vis: bool) -> bool:
        """Do nothing, because the user's own commands are not drawn; return False."""
        return False

    def _resample(self, env_ids: Any) -> None:
        """Sample new commands for the environments `env_ids` now, and the time for which they last.

        `_update_command` may call this method before the resampling time is over.
        """
        if len(env_ids) == 0:
            return
        if not self.rlcli_draws_time:
            self.time_left[env_ids] = self.time_left[env_ids].uniform_(*self.cfg.resampling_time_range)
        self._resample_command(env_ids)
        self.command_counter[env_ids] += 1

    def _update_metrics(self) -> None:
        """Update the metrics, once per step, before commands are resampled."""

    def _resample_command(self, env_ids: Any) -> None:
        """Sample new commands for the environments `env_ids`."""
        raise NotImplementedError

    def _update_command(self) -> None:
        """Update the commands, once per step, after they are resampled."""


ObsTerm, ObsGroup, RewTerm, DoneTerm, EventTerm, CurrTerm = (
    ObservationTermCfg, ObservationGroupCfg, RewardTermCfg, TerminationTermCfg, EventTermCfg, CurriculumTermCfg,
)  # fmt: skip

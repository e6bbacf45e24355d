"""`DirectRLEnv`: direct tasks of Isaac Lab.

A task of Isaac Lab that imports a name from `isaaclab.envs` gets the object of this name from here.

rlcli runs a direct task as a manager-based one with one action, one reward and so on, which call the hooks of the task
(`direct_terms.py`).
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from rlcli.errors import ConfigError, Problem, TaskError
from rlcli_isaaclab.config_class import MISSING, configclass, fill_missing
from rlcli_isaaclab.setup_scene import Setup, running
from rlcli_isaaclab.sim import SimulationCfg
from rlcli_isaaclab.simulation import Simulation
from rlcli_isaaclab.task_fields import set_valid_fields
from rlcli_isaaclab.user_files import adapt_to_device

MANAGED: ContextVar[Any] = ContextVar("managed")
"""Environment of rlcli that is now creating an object of the task's class."""


@contextlib.contextmanager
def building(managed: Any) -> Iterator[None]:
    """Set the environment whose USD stage the task's code reads, for the duration of the `with` block."""
    token = MANAGED.set(managed)
    try:
        yield
    finally:
        MANAGED.reset(token)


class DirectRLEnv(gymnasium.Env):
    """Base class of direct tasks; a subclass implements hooks such as `_get_rewards`. rlcli creates the object."""

    metadata = {"render_modes": [None]}  # noqa: RUF012  (gymnasium's)

    def __init__(self, cfg: Any, render_mode: str | None = None, **kwargs: Any) -> None:
        from rlcli_isaaclab.scene_facade import Scene

        managed = MANAGED.get(None)
        if managed is None:
            raise TaskError("a DirectRLEnv cannot be created by itself", hint="use `rlcli train`, or rlcli.api.make")
        if isinstance(managed, _Shell):
            for name, value in {"cfg": cfg, "sim": managed.sim, "scene": managed.scene, "managed": managed}.items():
                self.__dict__[name] = value
            self._setup_scene()
            raise _Recorded(self)
        self.cfg, self.managed, self.render_mode = cfg, managed, render_mode
        self.sim = Simulation(cfg.sim, str(managed.device), managed.physics_dt)
        self.scene = Scene(managed)
        self.extras: dict[str, Any] = {}
        n, device = managed.num_envs, managed.device
        self.single_action_space = _space(cfg.action_space, "action_space")
        self.single_observation_space = gymnasium.spaces.Dict(
            {"policy": _space(cfg.observation_space, "observation_space")}
        )
        self.state_space = _space(cfg.state_space, "state_space") if cfg.state_space else None
        self.actions = torch.zeros(n, gymnasium.spaces.flatdim(self.single_action_space), device=device)
        self.reset_terminated, self.reset_time_outs, self.reset_buf = (
            torch.zeros(n, dtype=torch.bool, device=device) for _ in range(3)
        )
        self.reward_buf = torch.zeros(n, device=device)
        self.obs_buf: dict[str, Any] = {}
        setup = Setup(self._bind)
        with running(setup):
            self._setup_scene()

    def _bind(self, created: Any, index: int) -> None:
        """Connect an object that `_setup_scene` has created with its part of the simulation."""
        from rlcli_isaaclab.scene_facade import Asset
        from rlcli_isaaclab.sensor_facade import TerrainImporter, bound_parts

        name = self.cfg.rlcli_names[index]
        if isinstance(created, TerrainImporter):
            created.bind(self.managed, self.managed.terrain)
        elif isinstance(created, Asset):
            created.bind(self.managed, self.managed.entities[name])
            self.scene.articulations[name] = created
        else:
            created.bind(*bound_parts(name, self.managed.sensors))

    @property
    def unwrapped(self) -> Any:
        """The environment itself."""
        return self

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self.managed.num_envs

    @property
    def device(self) -> str:
        """Device of the tensors."""
        return str(self.managed.device)

    @property
    def physics_dt(self) -> float:
        """Period of a physics step [s]."""
        return self.managed.physics_dt

    @property
    def step_dt(self) -> float:
        """Control period [s]."""
        return self.managed.step_dt

    @property
    def max_episode_length(self) -> int:
        """Maximum length of an episode [steps]."""
        return self.managed.max_episode_length

    @property
    def max_episode_length_s(self) -> float:
        """Maximum length of an episode [s]."""
        return self.managed.config.episode_length_s

    @property
    def common_step_counter(self) -> int:
        """Environment steps since the start."""
        return self.managed.common_step

    @property
    def episode_length_buf(self) -> Tensor:
        """Steps of the running episodes. (num_envs,) int64"""
        return self.managed.episode_length_buf

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        self.managed.episode_length_buf.copy_(value)

    @property
    def action_space(self) -> Any:  # type: ignore[override]  # gymnasium has an attribute
        """Action space of all environments."""
        return gymnasium.vector.utils.batch_space(self.single_action_space, self.num_envs)

    @property
    def observation_space(self) -> Any:  # type: ignore[override]  # gymnasium has an attribute
        """Observation space of all environments."""
        return gymnasium.vector.utils.batch_space(self.single_observation_space, self.num_envs)

    @property
    def event_manager(self) -> Any:
        """Manager of the task's events."""
        return self.managed.event_manager

    def set_debug_vis(self, debug_vis: bool) -> bool:
        """Do nothing: rlcli does not draw the markers of direct tasks. Return False."""
        return False

    def _setup_scene(self) -> None:
        """Create the assets and sensors of the scene. The base class creates none."""

    def _pre_physics_step(self, actions: Tensor) -> None:
        """Store or process the actions, once per environment step. (num_envs, a)"""
        raise NotImplementedError(f"class {type(self).__name__} has no method _pre_physics_step; implement it")

    def _apply_action(self) -> None:
        """Write targets to the assets, before each physics step."""
        raise NotImplementedError(f"class {type(self).__name__} has no method _apply_action; implement it")

    def _get_observations(self) -> Any:
        """Return the observations, once per environment step: name of the group -> (num_envs, ...)."""
        raise NotImplementedError(f"class {type(self).__name__} has no method _get_observations; implement it")

    def _get_states(self) -> Any:
        """Return the observations of the critic, (num_envs, ...); called only if `state_space` is set."""

    def _get_rewards(self) -> Tensor:
        """Return the reward of each environment in this step. (num_envs,)"""
        raise NotImplementedError(f"class {type(self).__name__} has no method _get_rewards; implement it")

    def _get_dones(self) -> tuple[Tensor, Tensor]:
        """Return where the task terminated the episode, and where the episode timed out. (num_envs,) bool each"""
        raise NotImplementedError(f"class {type(self).__name__} has no method _get_dones; implement it")

    def _reset_idx(self, env_ids: Any) -> None:
        """Remove the forces on bodies in the environments `env_ids`, and run reset events; rlcli resets the rest."""
        for asset in self.scene.articulations.values():
            asset.reset(env_ids)
        if self.rlcli_fire_resets is not None:
            self.rlcli_fire_resets()

    rlcli_fire_resets: Any = None
    """Function that runs the reset events in the environments that are now reset; None outside of a reset."""

    def _set_debug_vis_impl(self, debug_vis: bool) -> None:
        """Do nothing: rlcli does not draw the markers of direct tasks."""


class DirectMARLEnv(gymnasium.Env):
    """A multi-agent task, which rlcli does not support."""

    def __init__(self, cfg: Any, *args: Any, **kwargs: Any) -> None:
        raise TaskError("rlcli does not support multi-agent tasks", hint="write a DirectRLEnv with one agent")


@configclass
class DirectRLEnvCfg:
    """Configuration of a direct task."""

    viewer: Any = None
    sim: Any = SimulationCfg()
    ui_window_class_type: Any = None
    seed: Any = None
    decimation: int = MISSING
    is_finite_horizon: bool = False
    episode_length_s: float = MISSING
    scene: Any = MISSING
    events: Any = None
    observation_space: Any = MISSING
    num_observations: Any = None
    state_space: Any = None
    num_states: Any = None
    observation_noise_model: Any = None
    action_space: Any = MISSING
    num_actions: Any = None
    action_noise_model: Any = None
    rerender_on_reset: bool = False
    num_rerenders_on_reset: int = 0
    wait_for_textures: bool = True
    xr: Any = None
    log_dir: Any = None

    def __rlcli_fill__(self, values: Mapping[tuple[str, ...], Any]) -> list[tuple[str, ...]]:
        """Set missing settings and the task's own fields from `values` (path -> value).

        Return the paths of the settings that were missing.
        """
        set_valid_fields(self, DirectRLEnvCfg, values)  # `_setup_scene` may read them
        return fill_missing(self, values)

    def __rlcli_environment__(self, entry: Any) -> None:
        """Store the environment class that the task's Gymnasium registration names, as a class or `module:Class`."""
        self.rlcli_class = entry

    def __rlcli_task__(self, root: Path, models: Mapping[str, Any]) -> Any:
        """Return this configuration as a task of rlcli; `models` are the values of `--model`, NAME -> FILE."""
        from rlcli_isaaclab.direct_convert import direct_task

        return direct_task(self, _environment_class(self), root, models)


@configclass
class DirectMARLEnvCfg:
    """Configuration of a multi-agent task, which rlcli does not support."""

    def __rlcli_task__(self, root: Path, models: Mapping[str, Any]) -> Any:
        """Raise ConfigError: rlcli does not support multi-agent tasks."""
        raise ConfigError(
            [
                Problem(
                    "configuration",
                    "",
                    "a DirectMARLEnv has several agents; rlcli does not support multi-agent tasks",
                    "write a DirectRLEnv with one agent",
                )
            ]
        )


def _environment_class(cfg: Any) -> type[DirectRLEnv]:
    """Return the environment class: the registered one, or else the only one in the configuration's module.

    Raises:
        ConfigError: if there is none, if there are several, or if the object is not a DirectRLEnv.
    """
    from rlcli.registry import load_object

    entry = getattr(cfg, "rlcli_class", None)
    if entry is not None:
        found = load_object(entry) if isinstance(entry, str) else entry
    else:
        module = sys.modules[type(cfg).__module__]
        kinds = [v for v in vars(module).values() if isinstance(v, type) and v.__module__ == module.__name__]
        kinds = [kind for kind in kinds if issubclass(kind, DirectRLEnv)]
        kinds = [kind for kind in kinds if not any(issubclass(k, kind) and k is not kind for k in kinds)]
        if len(kinds) != 1:
            what = f"the module of {type(cfg).__name__} has {len(kinds)} subclasses of DirectRLEnv, expected 1"
            hint = "on the command line, name the registered task as FOLDER:ID"
            raise ConfigError([Problem("configuration", "", what, hint)])
        found = kinds[0]
    if not (isinstance(found, type) and issubclass(found, DirectRLEnv)):
        raise ConfigError(
            [Problem("configuration", "", f"{entry} is not a class derived from DirectRLEnv", "register such a class")]
        )
    return found


def record(env_class: type[DirectRLEnv], cfg: Any) -> tuple[Setup, Any]:
    """Run the task's `__init__` up to the end of `_setup_scene`, without a simulation.

    Return (objects that `_setup_scene` created, environment). The task's `__init__` may change `cfg`.

    Raises:
        TaskError: if the task's `__init__` does not call the `__init__` of DirectRLEnv.
    """
    setup = Setup()
    with running(setup), building(_Shell(cfg)):
        try:
            adapt_to_device(env_class, "cpu")(cfg)
        except _Recorded as recorded:
            return setup, recorded.env
    raise TaskError(f"{env_class.__name__}.__init__ does not call super().__init__(cfg, ...)", hint="add the call")


class _Recorded(BaseException):
    """Exception that leaves `__init__` after `_setup_scene`. No `except Exception` in the task catches it."""

    def __init__(self, env: DirectRLEnv) -> None:
        self.env = env


class _Shell:
    """Stand-in for the environment of rlcli before it exists, with the values that `_setup_scene` may read."""

    def __init__(self, cfg: Any) -> None:
        self.device, self.num_envs = "cpu", cfg.scene.num_envs
        self.entities: dict[str, Any] = {}
        self.physics_dt, self.step_dt = cfg.sim.dt, cfg.sim.dt * cfg.decimation
        self.sim = Simulation(cfg.sim, "cpu", cfg.sim.dt)
        self.scene = SimpleNamespace(
            cfg=cfg.scene, articulations={}, rigid_objects={}, sensors={}, extras={}, deformable_objects={},
            clone_environments=lambda **options: None, filter_collisions=lambda **options: None,
            num_envs=cfg.scene.num_envs, env_origins=torch.zeros(cfg.scene.num_envs, 3),
            env_prim_paths=["/World/envs/env_0"],
        )  # fmt: skip


def _space(value: Any, name: str) -> Any:
    """Return the space that a setting describes: a number of columns, a shape, or a Box.

    Raises:
        ConfigError: for another kind of space.
    """
    if isinstance(value, gymnasium.spaces.Box):
        return value
    if isinstance(value, int) and not isinstance(value, bool):
        return gymnasium.spaces.Box(-np.inf, np.inf, (value,))
    if isinstance(value, list | tuple) and value and all(isinstance(size, int) for size in value):
        return gymnasium.spaces.Box(-np.inf, np.inf, tuple(value))
    kind = type(value).__name__
    what = f"a space of type {kind} is not supported; rlcli has only continuous actions and array observations"
    raise ConfigError([Problem("configuration", name, what, "give a number of columns, a shape or a Box")])


def shape_of(value: Any, name: str) -> tuple[int, ...]:
    """Return the shape of a space; see `_space` for errors."""
    return tuple(_space(value, name).shape)

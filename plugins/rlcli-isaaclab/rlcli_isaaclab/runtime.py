"""`ManagerBasedRLEnv`, an environment of rlcli with Isaac Lab's interface. The user's terms receive it as `env`."""

from __future__ import annotations

import copy
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from rlcli.config.load import resolve
from rlcli.config.python_task import source_of
from rlcli.envs.make import make_env
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import did_you_mean, listing
from rlcli.registry import is_framework, load_object
from rlcli_isaaclab.extras_log import ExtrasLog
from rlcli_isaaclab.manager_facade import (
    ActionManagerFacade,
    CommandManagerFacade,
    ManagerFacade,
    ObservationManagerFacade,
    RewardManagerFacade,
    TerminationManagerFacade,
)
from rlcli_isaaclab.missing_names import user_place
from rlcli_isaaclab.multirotor import Multirotor
from rlcli_isaaclab.scene_facade import Scene
from rlcli_isaaclab.settings import kind_of
from rlcli_isaaclab.simulation import Simulation


class ManagerBasedRLEnv(gymnasium.Env):
    """Manager-based environment with Isaac Lab's attributes; `managed` is rlcli's environment, which does the work."""

    metadata = {"render_modes": [None]}  # noqa: RUF012  (gymnasium's)

    def __init__(self, cfg: Any = None, render_mode: str | None = None, **kwargs: Any) -> None:
        if "managed" in self.__dict__:  # `__init__` of the task's own class, called when a term uses the class
            return
        if cfg is None:
            entry = kwargs["env_cfg_entry_point"]
            cfg = load_object(entry) if isinstance(entry, str) else entry
        cfg = cfg() if isinstance(cfg, type) else cfg
        file = getattr(sys.modules.get(type(cfg).__module__), "__file__", None)
        device = kwargs.get("device") or (cfg.sim.device if torch.cuda.is_available() else "cpu")
        resolved = resolve(source_of(cfg, Path(file).parent if file else None))
        managed = make_env(resolved, seed=42 if cfg.seed is None else cfg.seed, device=device)
        self.__dict__ = facade_of(managed).__dict__  # terms receive the object of `facade_of`: share its attributes
        self.cfg = cfg

    @classmethod
    def _of(cls, managed: VecEnv) -> ManagerBasedRLEnv:
        facade = cls.__new__(cls)
        facade.managed, facade.cfg, facade.extras = managed, managed.config, {"log": {}}
        facade.managed.task_log = ExtrasLog(lambda: facade.extras)
        facade._scene, facade._manager_facades = None, {}
        return facade

    managed: Any
    cfg: Any
    _own: Any
    """Object of the environment class that the task defines, created when a term first uses a member of the class."""
    extras: dict[str, Any]
    selection: Any = None
    """The environments for which a term is called; None outside of such a call."""
    _context: Any = None
    _has_run_reset_events = False
    _scene: Scene | None
    _manager_facades: dict[str, Any]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name in ("managed", "cfg"):
            raise AttributeError(name)
        if not hasattr(self.managed, name):
            own = environment_class(getattr(self.cfg, "_rlcli_class", None))
            if own is not None and "_own" not in self.__dict__:
                self.__dict__["_own"] = object.__new__(own)
                self._own.__dict__ = self.__dict__  # the object has the attributes of the environment
                try:
                    self._own.__init__(self.cfg)
                except BaseException:  # the next use of a member has to fail as well
                    del self.__dict__["_own"]
                    raise
            if own is not None and (name in self.__dict__ or hasattr(own, name)):
                return getattr(self._own, name)
            if name.endswith("_manager") and name in dir(type(self)):
                raise AttributeError(
                    f"{user_place()}env has no '{name}' yet: {_CREATED}; use it in reset() or __call__()"
                )
            known = [n for n in (*dir(type(self)), *dir(self.managed)) if not n.startswith("_")]
            hint = did_you_mean(name, known) or f"its attributes: {listing(sorted(set(known)), 60)}"
            raise AttributeError(f"env has no '{name}'; {hint}")
        return getattr(self.managed, name)

    @property
    def scene(self) -> Scene:
        """Robots, objects, sensors and terrain of the scene, by name."""
        if self._scene is None:
            self._scene = Scene(self.managed)
        return self._scene

    @property
    def action_manager(self) -> Any:
        """Action manager under Isaac Lab's names."""
        return self._manager("action_manager", ActionManagerFacade)

    @property
    def termination_manager(self) -> Any:
        """Termination manager under Isaac Lab's names."""
        return self._manager("termination_manager", TerminationManagerFacade)

    @property
    def command_manager(self) -> Any:
        """Command manager under Isaac Lab's names."""
        return self._manager("command_manager", CommandManagerFacade)

    @property
    def reward_manager(self) -> Any:
        """Reward manager under Isaac Lab's names. In `__init__` of a curriculum term it only has the reward terms."""
        bound = getattr(self.managed, "_bound", {})
        if not hasattr(self.managed, "reward_manager") and "rewards" in bound:
            return RewardManagerFacade(SimpleNamespace(terms=bound["rewards"]), self.managed._binder.tunable)
        return self._manager(
            "reward_manager", lambda manager: RewardManagerFacade(manager, self.managed._binder.tunable)
        )

    @property
    def curriculum_manager(self) -> Any:
        """Curriculum manager under Isaac Lab's names."""
        return self._manager("curriculum_manager", ManagerFacade)

    @property
    def event_manager(self) -> Any:
        """Event manager under Isaac Lab's names."""
        return self._manager("event_manager", ManagerFacade)

    @property
    def max_episode_length_s(self) -> float:
        """Maximum length of an episode [s]."""
        return self.managed.config.episode_length_s

    @property
    def common_step_counter(self) -> Tensor:
        """Environment steps since the start. () int64"""
        return self.managed._counters.common_step

    @property
    def reset_terminated(self) -> Tensor:
        """Whether the episode of each environment was terminated in this step. (num_envs,) bool"""
        return self.managed.termination_manager.terminated

    @property
    def reset_buf(self) -> Tensor:
        """Whether the episode of each environment ended in this step, by termination or time-out. (num_envs,) bool"""
        return self.reset_terminated | self.reset_time_outs

    @property
    def reset_time_outs(self) -> Tensor:
        """Whether the episode of each environment reached its time limit in this step. (num_envs,) bool"""
        return self.managed.termination_manager.time_outs

    @property
    def single_action_space(self) -> gymnasium.spaces.Box:
        """Action space of one environment."""
        return gymnasium.spaces.Box(-np.inf, np.inf, (self.managed.layout.action_size,))

    @property
    def single_observation_space(self) -> gymnasium.spaces.Dict:
        """Observation space of one environment, by group."""
        groups = self.managed.layout.observations
        sizes = {name: sum(term.size for term in terms) for name, terms in groups.items()}
        return gymnasium.spaces.Dict(
            {name: gymnasium.spaces.Box(-np.inf, np.inf, (size,)) for name, size in sizes.items()}
        )

    @property
    def action_space(self) -> Any:  # type: ignore[override]  # gymnasium has an attribute
        """Action space of all environments."""
        return gymnasium.vector.utils.batch_space(self.single_action_space, self.managed.num_envs)

    @property
    def observation_space(self) -> Any:  # type: ignore[override]  # gymnasium has an attribute
        """Observation space of all environments."""
        return gymnasium.vector.utils.batch_space(self.single_observation_space, self.managed.num_envs)

    def reset(self, *, seed: int | None = None, options: Any = None, env_ids: Any = None) -> Any:
        """Reset all environments. Return (observations by group, `extras`, a dict of values to log).

        `options` and `env_ids` have no effect.
        """
        return self.managed.reset(seed), self.extras

    def step(self, action: Tensor) -> Any:
        """Step all environments with actions (num_envs, a).

        Return (observations by group, reward, terminated, truncated, `extras`), with (num_envs,) for the three tensors.
        """
        result = self.managed.step(action.to(self.managed.device))
        if result.episodes is not None:
            ended = result.episodes.ended()
            length = self.max_episode_length_s
            terms = {f"Episode_Reward/{n}": v.mean() / length for n, v in ended.reward_terms.items() if len(v)}
            causes = {f"Episode_Termination/{n}": v.sum() for n, v in ended.causes.items()}
            self.extras["log"] = self.extras.get("log", {}) | terms | causes
        self.extras["time_outs"] = result.truncated
        return result.obs, result.reward, result.terminated, result.truncated, self.extras

    def render(self) -> None:
        """Do nothing; use `rlcli play --video` instead."""

    def close(self) -> None:
        """Free the threads and the memory of the simulation."""
        self.managed.close()

    def use(self, context: Any) -> None:
        """Give terms access to the user's configuration: as `cfg`, and its frame transformers and lights in `scene`."""
        self.scene.add_frames(context.frames)
        if context.cfg is not None and self._context is not context:
            self._context, self.cfg = context, copy.deepcopy(context.cfg)
            self.cfg.scene.num_envs, self.cfg.sim.device = self.managed.num_envs, str(self.managed.device)
            self.scene.user_cfg = self.cfg.scene
            for settings in vars(self.cfg.scene).values():
                if isinstance(getattr(settings, "prim_path", None), str):
                    settings.prim_path = settings.prim_path.replace("{ENV_REGEX_NS}", "/World/envs/env_.*")
            self.scene.add_collections(self.cfg.scene)
            for name, asset in self.scene.articulations.items():
                asset.cfg = getattr(self.cfg.scene, name, asset.cfg)
                if kind_of(getattr(asset.cfg, "class_type", None)) == "Multirotor":
                    made = self.scene.articulations[name] = Multirotor.of(self.managed, self.managed.entities[name])
                    made.cfg = asset.cfg
                    made.start()

    @property
    def unwrapped(self) -> Any:
        """The environment itself, which has no wrappers."""
        return self

    @property
    def sim(self) -> Simulation:
        """Settings of the simulation under Isaac Lab's names."""
        return Simulation(self.cfg.sim, str(self.managed.device), self.managed.physics_dt)

    @property
    def observation_manager(self) -> Any:
        """Observation manager under Isaac Lab's names."""
        return self._manager("observation_manager", ObservationManagerFacade)

    @property
    def obs_buf(self) -> Any:
        """Observations of the last step, by group."""
        return self.managed._last_obs

    def run_own_reset_events(self) -> None:
        """Run reset events that are the user's functions, once, before the first episode.

        Such events may create attributes of the environment that observation terms read.
        """
        if self._has_run_reset_events:
            return
        self._has_run_reset_events = True
        for term in self.managed._bound["events"]:
            if term.config.mode == "reset" and type(term.call).__module__ == "rlcli_isaaclab.terms":
                term.call(self.managed._select_all().stream(term.stream))

    def open_weights(self) -> None:
        """Make the weights of all rewards changeable. Call this before the reward manager is created."""
        for name, config in self.managed.config.rewards.items():
            if config is not None:
                self.managed._binder.tunable.make_changeable(f"rewards.{name}.weight")

    def _manager(self, name: str, kind: Any) -> Any:
        manager = getattr(self.managed, name)
        if name not in self._manager_facades or self._manager_facades[name]._manager is not manager:
            self._manager_facades[name] = kind(manager)
        return self._manager_facades[name]


def environment_class(entry: Any) -> type | None:
    """Return the environment class that a task defines, a subclass of `ManagerBasedRLEnv`.

    `entry` is the class, or its reference `module:Class`. Return None for any other class and for classes of the
    frameworks themselves.
    """
    found = load_object(entry) if isinstance(entry, str) and entry != OWN_CLASS else entry
    own = isinstance(found, type) and issubclass(found, ManagerBasedRLEnv) and not is_framework(found.__module__)
    return found if own else None


_CREATED = "managers are created in the order commands, actions, terminations, rewards, observations, curriculum"
OWN_CLASS = "isaaclab.envs:ManagerBasedRLEnv"
"""Entry point of Isaac Lab's own environment class in a registration with Gymnasium."""


def facade_of(managed: VecEnv) -> ManagerBasedRLEnv:
    """Return the `ManagerBasedRLEnv` around an environment of rlcli; the first call creates it."""
    if "_isaaclab" not in vars(managed):
        vars(managed)["_isaaclab"] = ManagerBasedRLEnv._of(managed)
    return vars(managed)["_isaaclab"]

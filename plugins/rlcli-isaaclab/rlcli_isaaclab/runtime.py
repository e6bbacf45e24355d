"""The environment as terms written for Isaac Lab see it: `env.scene["robot"].data.joint_pos` and its kin."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
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
from rlcli.scene.entity import Entity
from rlcli.scene.names import NameProblem, match
from rlcli.sim.rotations import rotate, rotate_inverse

_DATA = {
    "applied_torque": "applied_effort",
    "computed_torque": "computed_effort",
    "root_link_pos_w": "root_pos_w",
    "root_link_quat_w": "root_quat_w",
    "root_link_lin_vel_w": "root_lin_vel_w",
    "root_link_ang_vel_w": "root_ang_vel_w",
    "root_link_lin_vel_b": "root_lin_vel_b",
    "root_link_ang_vel_b": "root_ang_vel_b",
    "body_link_pos_w": "body_pos_w",
    "body_link_quat_w": "body_quat_w",
    "body_link_lin_vel_w": "body_lin_vel_w",
    "body_link_ang_vel_w": "body_ang_vel_w",
}
"""Isaac Lab's name -> ours, where they differ."""


class Data:
    """The state of an asset under Isaac Lab's names; those of `rlcli.scene.entity_data.EntityData` work too."""

    def __init__(self, env: VecEnv, entity: Entity) -> None:
        self._env, self._entity, self._data = env, entity, entity.data
        self.joint_names, self.body_names = list(entity.joint_names), list(entity.names["Bodies"])

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        try:
            return getattr(self._data, _DATA.get(name, name))
        except AttributeError:
            known = [n for n in (*dir(type(self)), *dir(self._data), *_DATA) if not n.startswith("_")]
            raise AttributeError(f"data has no '{name}'; {did_you_mean(name, known) or listing(known, 60)}") from None

    def _everywhere(self, row: Tensor) -> Tensor:
        return row if row.dim() == 3 else row.expand(self._env.num_envs, *row.shape)

    @property
    def joint_pos_limits(self) -> Tensor:
        """(num_envs, joints, 2) [m or rad]"""
        return self._everywhere(self._data.joint_pos_limits)

    @property
    def soft_joint_pos_limits(self) -> Tensor:
        """(num_envs, joints, 2) [m or rad]"""
        return self._everywhere(self._data.soft_joint_pos_limits)

    @property
    def root_pose_w(self) -> Tensor:
        """Position and quaternion (w, x, y, z). (num_envs, 7)"""
        return torch.cat([self._data.root_pos_w, self._data.root_quat_w], dim=1)

    @property
    def root_vel_w(self) -> Tensor:
        """Linear and angular velocity. (num_envs, 6)"""
        return torch.cat([self._data.root_lin_vel_w, self._data.root_ang_vel_w], dim=1)

    @property
    def root_state_w(self) -> Tensor:
        """Pose and velocity. (num_envs, 13)"""
        return torch.cat([self.root_pose_w, self.root_vel_w], dim=1)

    root_link_pose_w, root_link_vel_w, root_link_state_w = root_pose_w, root_vel_w, root_state_w

    @property
    def body_state_w(self) -> Tensor:
        """Poses and velocities of all bodies. (num_envs, bodies, 13)"""
        d: Any = self._data
        return torch.cat([d.body_pos_w, d.body_quat_w, d.body_lin_vel_w, d.body_ang_vel_w], dim=-1)

    @property
    def GRAVITY_VEC_W(self) -> Tensor:  # noqa: N802
        """Direction of gravity. (num_envs, 3)"""
        return self._data._down

    @property
    def FORWARD_VEC_B(self) -> Tensor:  # noqa: N802
        """The x axis. (num_envs, 3)"""
        return torch.eye(3, device=self._env.device)[:1].expand(self._env.num_envs, 3)

    @property
    def heading_w(self) -> Tensor:
        """Direction of the root's x axis about z [rad]. (num_envs,)"""
        forward = rotate(self._data.root_quat_w, self.FORWARD_VEC_B)
        return torch.atan2(forward[:, 1], forward[:, 0])


class Asset:
    """A robot or object."""

    def __init__(self, env: VecEnv, entity: Entity) -> None:
        self._env, self._entity = env, entity
        self.cfg = entity.config
        self.data = Data(env, entity)
        self.joint_names, self.body_names = self.data.joint_names, self.data.body_names
        self.num_joints, self.num_bodies = len(self.joint_names), len(self.body_names)
        self.num_instances, self.device = env.num_envs, env.device
        self.is_fixed_base = not entity.is_floating

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        known = [n for n in (*dir(type(self)), *vars(self)) if not n.startswith("_")]
        near = did_you_mean(name, known) or (
            "there is no PhysX; its numbers are in data and in the events"
            if "physx" in name
            else f"it has {listing(known, 40)}"
        )
        raise AttributeError(f"an asset has no '{name}'; {near}")

    def find_joints(self, name_keys: Any, joint_subset: Any = None, preserve_order: bool = False) -> Any:
        """Ids and names of joints by names or regexes."""
        return _find(name_keys, joint_subset or self.joint_names, self.joint_names, "joint", preserve_order)

    def find_bodies(self, name_keys: Any, preserve_order: bool = False) -> Any:
        """Ids and names of bodies by names or regexes."""
        return _find(name_keys, self.body_names, self.body_names, "body", preserve_order)

    def write_joint_state_to_sim(
        self, position: Tensor, velocity: Tensor, joint_ids: Any = None, env_ids: Any = None
    ) -> None:
        """Set positions and velocities of joints. (rows, joints) each [m or rad, m/s or rad/s]"""
        self._set("qpos", self._entity.qpos_columns, position, joint_ids, env_ids)
        self._set("qvel", self._entity.dof_columns, velocity, joint_ids, env_ids)

    def write_joint_position_to_sim(self, position: Tensor, joint_ids: Any = None, env_ids: Any = None) -> None:
        """Set positions of joints. (rows, joints) [m or rad]"""
        self._set("qpos", self._entity.qpos_columns, position, joint_ids, env_ids)

    def write_joint_velocity_to_sim(self, velocity: Tensor, joint_ids: Any = None, env_ids: Any = None) -> None:
        """Set velocities of joints. (rows, joints) [m/s or rad/s]"""
        self._set("qvel", self._entity.dof_columns, velocity, joint_ids, env_ids)

    def write_root_pose_to_sim(self, root_pose: Tensor, env_ids: Any = None) -> None:
        """Set the root's position [m] and quaternion (w, x, y, z). (rows, 7)"""
        root, _ = self._entity.floating()
        columns = torch.arange(root, root + 7, device=self._env.device)
        self._set("qpos", columns, root_pose, None, env_ids)

    def write_root_velocity_to_sim(self, root_velocity: Tensor, env_ids: Any = None) -> None:
        """Set the root's linear [m/s] and angular [rad/s] velocity, world frame; set the pose first. (rows, 6)"""
        root, dof = self._entity.floating()
        rows = slice(None) if env_ids is None else env_ids
        quat = self._env.engine.field("qpos")[rows, root + 3 : root + 7].float()
        local = rotate_inverse(quat, root_velocity[:, 3:])
        columns = torch.arange(dof, dof + 6, device=self._env.device)
        self._set("qvel", columns, torch.cat([root_velocity[:, :3], local], dim=1), None, env_ids)

    def write_root_state_to_sim(self, root_state: Tensor, env_ids: Any = None) -> None:
        """Set the root's pose and velocity. (rows, 13)"""
        self.write_root_pose_to_sim(root_state[:, :7], env_ids)
        self.write_root_velocity_to_sim(root_state[:, 7:], env_ids)

    write_root_link_pose_to_sim, write_root_com_velocity_to_sim = write_root_pose_to_sim, write_root_velocity_to_sim
    write_root_link_state_to_sim, write_root_link_velocity_to_sim = write_root_state_to_sim, write_root_velocity_to_sim

    def _set(self, field: str, columns: Tensor, values: Tensor, joint_ids: Any, env_ids: Any) -> None:
        target = self._env.engine.field(field)
        columns = columns if joint_ids is None else columns[joint_ids].reshape(-1)
        rows = torch.arange(len(target), device=target.device) if env_ids is None else torch.as_tensor(env_ids)
        target[rows[:, None], columns] = values.to(target.dtype)
        self._env.sim.refresh()


class Scene(Mapping[str, Any]):
    """Assets and sensors by name."""

    def __init__(self, env: VecEnv) -> None:
        self._env = env
        self.articulations = {name: Asset(env, entity) for name, entity in env.entities.items()}
        self.rigid_objects = {name: a for name, a in self.articulations.items() if not a.joint_names}

    @property
    def sensors(self) -> Mapping[str, Any]:
        """Sensors by name."""
        return {name: Sensor(sensor) for name, sensor in getattr(self._env, "sensors", {}).items()}

    @property
    def num_envs(self) -> int:
        """Environments."""
        return self._env.num_envs

    @property
    def env_origins(self) -> Tensor:
        """Where each environment's start place lies in its world. (num_envs, 3) [m]"""
        origins = getattr(self._env, "origins", None)
        return torch.zeros(self._env.num_envs, 3, device=self._env.device) if origins is None else origins

    @property
    def terrain(self) -> Any:
        """The terrain."""
        return getattr(self._env, "terrain", None)

    def __getitem__(self, name: str) -> Any:
        if name in self.articulations:
            return self.articulations[name]
        sensors = self.sensors
        if name in sensors:
            return sensors[name]
        if name == "terrain" and self.terrain is not None:
            return self.terrain
        raise KeyError(f"no '{name}' in the scene: {listing([*self.articulations, *sensors])}")

    def __iter__(self) -> Iterator[str]:
        return iter([*self.articulations, *self.sensors])

    def __len__(self) -> int:
        return len(self.articulations) + len(self.sensors)

    def resolve(self, cfg: Any) -> None:
        """Look up what a `SceneEntityCfg` names.

        Raises:
            NameProblem: for what is not there.
        """
        if cfg.name not in self:
            near = did_you_mean(cfg.name, list(self)) or f"there are {listing(self)}"
            raise NameProblem(f"no '{cfg.name}' in the scene", near)
        thing = self[cfg.name]
        for kind in ("joint", "body"):
            wanted = getattr(cfg, f"{kind}_names")
            if wanted is None:
                continue
            names = getattr(thing, f"{kind}_names")
            ids, found = _find(wanted, names, names, kind, cfg.preserve_order)
            every = ids == list(range(len(names)))
            setattr(cfg, f"{kind}_names", found)
            setattr(cfg, f"{kind}_ids", slice(None) if every else torch.tensor(ids, device=self._env.device))


class Sensor:
    """A contact or ray sensor under Isaac Lab's names."""

    _NAMES = {  # noqa: RUF012  (never written)
        "net_forces_w": "force",
        "net_forces_w_history": "force_history",
        "current_air_time": "air_time",
        "current_contact_time": "contact_time",
        "ray_hits_w": "hits",
        "pos_w": "position",
    }

    def __init__(self, sensor: Any) -> None:
        self._sensor = sensor
        self.data = self
        self.body_names = list(getattr(sensor, "names", []))
        self.joint_names: list[str] = []

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._sensor, self._NAMES.get(name, name))

    def find_bodies(self, name_keys: Any, preserve_order: bool = False) -> Any:
        """Slots and names of bodies by names or regexes."""
        return _find(name_keys, self.body_names, self.body_names, "body", preserve_order)

    def compute_first_contact(self, dt: float, abs_tol: float = 1e-8) -> Tensor:
        """Where contact began in this step. (num_envs, bodies) bool"""
        return self._sensor.first_contact

    def compute_first_air(self, dt: float, abs_tol: float = 1e-8) -> Tensor:
        """Where contact ended in this step. (num_envs, bodies) bool"""
        return self._sensor.first_air


class _Manager:
    """A manager with what Isaac Lab's has besides."""

    def __init__(self, manager: Any) -> None:
        self._manager = manager

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._manager, name)

    @property
    def active_terms(self) -> list[str]:
        """Names, in order."""
        return [term.name for term in self._manager.terms]


class _Actions(_Manager):
    @property
    def total_action_dim(self) -> int:
        """Columns."""
        return self._manager.size

    def get_term(self, name: str) -> Any:
        """An action term; `processed_actions` is what it commands."""
        return _named(self._manager.terms, name, "action")


class _Terminations(_Manager):
    @property
    def dones(self) -> Tensor:
        """Ended in this step. (num_envs,) bool"""
        return self._manager.terminated | self._manager.time_outs

    def get_term(self, name: str) -> Tensor:
        """Where a term fired. (num_envs,) bool"""
        fired = self._manager.fired
        if name not in fired:
            raise NameProblem(f"no termination '{name}'; there are {listing(fired)}")
        return fired[name]


class _Commands(_Manager):
    def get_command(self, name: str) -> Tensor:
        """What is asked. (num_envs, k)"""
        return _named(self._manager.terms, name, "command").command

    def get_term(self, name: str) -> Any:
        """A command term; one of the user's own is the user's object."""
        found = _named(self._manager.terms, name, "command")
        return getattr(found, "term", found)


class _Rewards(_Manager):
    def __init__(self, manager: Any, live: Any) -> None:
        super().__init__(manager)
        self._live = live

    def get_term_cfg(self, name: str) -> Any:
        """The settings of a term; a weight that is assigned holds from the next step on."""
        found = {term.name: term for term in self._manager.terms}
        if name not in found:
            raise NameProblem(f"no reward '{name}'", did_you_mean(name, found) or f"there are {listing(found)}")
        return _RewardSettings(found[name].config, self._live.get((*found[name].path, "weight")))

    def set_term_cfg(self, name: str, cfg: Any) -> None:
        """Take over the weight of settings."""
        self.get_term_cfg(name).weight = cfg.weight


class _RewardSettings:
    """The settings of a reward; only the weight can be changed, and only by a curriculum term."""

    def __init__(self, config: Any, weight: Tensor | None) -> None:
        self._config, self._weight = config, weight
        self.params: Mapping[str, Any] = MappingProxyType(config.params)

    @property
    def weight(self) -> float:
        """The weight that holds now."""
        return self._config.weight if self._weight is None else float(self._weight)

    @weight.setter
    def weight(self, value: float) -> None:
        if self._weight is None:
            raise AttributeError("the weight of a reward is changed by a curriculum term")
        self._weight.fill_(value)


class ManagerBasedRLEnv(gymnasium.Env):
    """A manager-based environment with Isaac Lab's attributes; `managed` is rlcli's own."""

    metadata = {"render_modes": [None]}  # noqa: RUF012  (gymnasium's)

    def __init__(self, cfg: Any = None, render_mode: str | None = None, **kwargs: Any) -> None:
        if cfg is None:
            from rlcli.registry import load_object

            entry = kwargs["env_cfg_entry_point"]
            cfg = load_object(entry) if isinstance(entry, str) else entry
        cfg = cfg() if isinstance(cfg, type) else cfg
        file = getattr(sys.modules.get(type(cfg).__module__), "__file__", None)
        device = kwargs.get("device") or (cfg.sim.device if torch.cuda.is_available() else "cpu")
        resolved = resolve(source_of(cfg, Path(file).parent if file else None))
        managed = make_env(resolved, seed=42 if cfg.seed is None else cfg.seed, device=device)
        self.__dict__ = facade_of(managed).__dict__  # what terms see is this very environment
        self.cfg = cfg

    @classmethod
    def _of(cls, managed: VecEnv) -> ManagerBasedRLEnv:
        made = cls.__new__(cls)
        made.managed, made.cfg, made.extras = managed, managed.config, {}
        made._scene, made._wrapped = None, {}
        return made

    managed: Any
    cfg: Any
    extras: dict[str, Any]
    _scene: Scene | None
    _wrapped: dict[str, Any]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_") or name in ("managed", "cfg"):
            raise AttributeError(name)
        if not hasattr(self.managed, name):
            if name.endswith("_manager") and name in dir(type(self)):
                raise AttributeError(
                    f"env has no '{name}' yet: it is made after the terms have given their first values"
                )
            known = [n for n in (*dir(type(self)), *dir(self.managed)) if not n.startswith("_")]
            raise AttributeError(f"env has no '{name}'; {did_you_mean(name, known) or listing(sorted(set(known)), 60)}")
        return getattr(self.managed, name)

    @property
    def scene(self) -> Scene:
        """Assets and sensors by name."""
        if self._scene is None:
            self._scene = Scene(self.managed)
        return self._scene

    @property
    def action_manager(self) -> Any:
        """Actions."""
        return self._manager("action_manager", _Actions)

    @property
    def termination_manager(self) -> Any:
        """Terminations."""
        return self._manager("termination_manager", _Terminations)

    @property
    def command_manager(self) -> Any:
        """Commands."""
        return self._manager("command_manager", _Commands)

    @property
    def reward_manager(self) -> Any:
        """Rewards."""
        return self._manager("reward_manager", lambda manager: _Rewards(manager, self.managed._binder.tunable))

    @property
    def max_episode_length_s(self) -> float:
        """Length of an episode [s]."""
        return self.managed.config.episode_length_s

    @property
    def common_step_counter(self) -> Tensor:
        """Steps since the start. () int64"""
        return self.managed._counters.common_step

    @property
    def reset_terminated(self) -> Tensor:
        """Terminated in this step. (num_envs,) bool"""
        return self.managed.termination_manager.terminated

    @property
    def reset_buf(self) -> Tensor:
        """Terminated or timed out in this step. (num_envs,) bool"""
        return self.reset_terminated | self.reset_time_outs

    @property
    def reset_time_outs(self) -> Tensor:
        """Timed out in this step. (num_envs,) bool"""
        return self.managed.termination_manager.time_outs

    @property
    def single_action_space(self) -> gymnasium.spaces.Box:
        """The action of one environment."""
        return gymnasium.spaces.Box(-np.inf, np.inf, (self.managed.layout.action_size,))

    @property
    def single_observation_space(self) -> gymnasium.spaces.Dict:
        """The observations of one environment, by group."""
        groups = self.managed.layout.observations
        sizes = {name: sum(term.size for term in terms) for name, terms in groups.items()}
        return gymnasium.spaces.Dict(
            {name: gymnasium.spaces.Box(-np.inf, np.inf, (size,)) for name, size in sizes.items()}
        )

    @property
    def action_space(self) -> Any:  # type: ignore[override]  # made when first read
        """The actions of all environments."""
        return gymnasium.vector.utils.batch_space(self.single_action_space, self.managed.num_envs)

    @property
    def observation_space(self) -> Any:  # type: ignore[override]  # made when first read
        """The observations of all environments."""
        return gymnasium.vector.utils.batch_space(self.single_observation_space, self.managed.num_envs)

    def reset(self, *, seed: int | None = None, options: Any = None, env_ids: Any = None) -> Any:
        """Begin an episode in every environment. -> observations by group, extras"""
        return self.managed.reset(seed), self.extras

    def step(self, action: Tensor) -> Any:
        """One step. -> observations by group, reward, terminated, truncated, extras"""
        done = self.managed.step(action.to(self.managed.device))
        self.extras["log"] = {}
        if done.episodes is not None:
            ended = done.episodes.ended()
            length = self.max_episode_length_s
            terms = {f"Episode_Reward/{n}": v.mean() / length for n, v in ended.reward_terms.items() if len(v)}
            causes = {f"Episode_Termination/{n}": v.sum() for n, v in ended.causes.items()}
            self.extras["log"] = {**terms, **causes}
        self.extras["time_outs"] = done.truncated
        return done.obs, done.reward, done.terminated, done.truncated, self.extras

    def render(self) -> None:
        """`rlcli play --video` draws."""

    def close(self) -> None:
        """Let go of the engine."""
        self.managed.close()

    def open_weights(self) -> None:
        """Let the weights of rewards change; before the reward manager is made."""
        for name, config in self.managed.config.rewards.items():
            if config is not None:
                self.managed._binder.tunable.open(f"rewards.{name}.weight")

    def _manager(self, name: str, kind: Any) -> Any:
        manager = getattr(self.managed, name)
        if name not in self._wrapped or self._wrapped[name]._manager is not manager:
            self._wrapped[name] = kind(manager)
        return self._wrapped[name]


def facade_of(managed: VecEnv) -> ManagerBasedRLEnv:
    """The environment as Isaac Lab's terms see it; one for each."""
    if "_isaaclab" not in vars(managed):
        vars(managed)["_isaaclab"] = ManagerBasedRLEnv._of(managed)
    return vars(managed)["_isaaclab"]


def _named(terms: Any, name: str, what: str) -> Any:
    found = {term.name: term.instance for term in terms}
    if name not in found:
        raise NameProblem(f"no {what} '{name}'; there are {listing(found)}")
    return found[name]


def _find(wanted: Any, among: Any, names: list[str], what: str, preserve_order: bool) -> tuple[list[int], list[str]]:
    positions = [names.index(among[p]) for p in match(wanted, list(among), what)]
    positions = positions if preserve_order else sorted(positions)
    return positions, [names[p] for p in positions]

"""Assets, sensors and the scene as Isaac Lab's terms expect them: `env.scene["robot"].data.joint_pos`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.errors import TaskError, did_you_mean, listing
from rlcli.scene.entity import Entity
from rlcli.scene.names import NameProblem
from rlcli.sim.rotations import rotate, rotate_inverse
from rlcli_isaaclab.absent import NoEffect
from rlcli_isaaclab.asset_commands import BodyWrench, JointDrive, PhysxView
from rlcli_isaaclab.sensor_facade import FrameTransformer, TerrainImporter, bound, camera_or_sensor, find_elements
from rlcli_isaaclab.setup_scene import current_setup

_DATA_NAMES = {
    "applied_torque": "applied_effort",
    "root_link_heading_w": "heading_w",
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
"""Isaac Lab's name -> rlcli's name, where they differ."""


_MOST_VELOCITY = math.radians(1e6)
"""Speed limit of a joint without a limit in Isaac Sim [rad/s]. It is finite, because terms multiply it by 0."""


class Data:
    """State of an asset under Isaac Lab's names. The names of `rlcli.scene.entity_data.EntityData` work too."""

    def __init__(self, env: VecEnv, entity: Entity) -> None:
        self._env, self._entity, self._data = env, entity, entity.data
        self.joint_names, self.body_names = list(entity.joint_names), list(entity.names["Bodies"])

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        try:
            return getattr(self._data, _DATA_NAMES.get(name, name))
        except AttributeError:
            known = [n for n in (*dir(type(self)), *dir(self._data), *_DATA_NAMES) if not n.startswith("_")]
            hint = did_you_mean(name, known) or f"its attributes: {listing(known, 60)}"
            raise AttributeError(f"data has no '{name}'; {hint}") from None

    def _expand_to_envs(self, row: Tensor) -> Tensor:
        return row if row.dim() == 3 else row.expand(self._env.num_envs, *row.shape)

    @property
    def joint_pos_limits(self) -> Tensor:
        """Lower and upper position limits. (num_envs, joints, 2) [m or rad]"""
        return self._expand_to_envs(self._data.joint_pos_limits)

    @property
    def joint_vel_limits(self) -> Tensor:
        """Speed limits. (num_envs, joints) [m/s or rad/s]"""
        limits = self._data.joint_vel_limits.clamp(max=_MOST_VELOCITY)
        return limits if limits.dim() == 2 else limits.expand(self._env.num_envs, -1)

    soft_joint_vel_limits = joint_vel_limits

    @property
    def soft_joint_pos_limits(self) -> Tensor:
        """Lower and upper soft limits. (num_envs, joints, 2) [m or rad]"""
        return self._expand_to_envs(self._data.soft_joint_pos_limits)

    @property
    def root_pose_w(self) -> Tensor:
        """Root position [m] and quaternion (w, x, y, z), world frame. (num_envs, 7)"""
        return torch.cat([self._data.root_pos_w, self._data.root_quat_w], dim=1)

    @property
    def root_vel_w(self) -> Tensor:
        """Root linear [m/s] and angular [rad/s] velocity, world frame. (num_envs, 6)"""
        return torch.cat([self._data.root_lin_vel_w, self._data.root_ang_vel_w], dim=1)

    @property
    def root_state_w(self) -> Tensor:
        """Root pose and velocity, world frame. (num_envs, 13)"""
        return torch.cat([self.root_pose_w, self.root_vel_w], dim=1)

    root_link_pose_w, root_link_vel_w, root_link_state_w = root_pose_w, root_vel_w, root_state_w

    @property
    def body_vel_w(self) -> Tensor:
        """Linear [m/s] and angular [rad/s] velocities of all bodies, world frame. (num_envs, bodies, 6)"""
        return torch.cat([self._data.body_lin_vel_w, self._data.body_ang_vel_w], dim=-1)

    @property
    def body_pose_w(self) -> Tensor:
        """Positions [m] and quaternions (w, x, y, z) of all bodies, world frame. (num_envs, bodies, 7)"""
        return torch.cat([self._data.body_pos_w, self._data.body_quat_w], dim=-1)

    body_link_pose_w, body_com_vel_w = body_pose_w, body_vel_w

    @property
    def body_state_w(self) -> Tensor:
        """Poses and velocities of all bodies, world frame. (num_envs, bodies, 13)"""
        d: Any = self._data
        return torch.cat([d.body_pos_w, d.body_quat_w, d.body_lin_vel_w, d.body_ang_vel_w], dim=-1)

    @property
    def GRAVITY_VEC_W(self) -> Tensor:  # noqa: N802
        """Unit vector along gravity, world frame. (num_envs, 3)"""
        return self._data._down

    @property
    def FORWARD_VEC_B(self) -> Tensor:  # noqa: N802
        """Unit vector along the x axis. (num_envs, 3)"""
        return torch.eye(3, device=self._env.device)[:1].expand(self._env.num_envs, 3)

    @property
    def heading_w(self) -> Tensor:
        """Angle of the root's x axis around z, world frame [rad]. (num_envs,)"""
        forward = rotate(self._data.root_quat_w, self.FORWARD_VEC_B)
        return torch.atan2(forward[:, 1], forward[:, 0])


class Asset:
    """A robot or an object."""

    def __init__(self, cfg: Any) -> None:
        current_setup().add(self, cfg)

    @classmethod
    def of(cls, env: VecEnv, entity: Entity) -> Asset:
        """Return the asset of an entity."""
        asset = cls.__new__(cls)
        asset.cfg = entity.config
        asset.bind(env, entity)
        return asset

    cfg: Any

    def bind(self, env: VecEnv, entity: Entity) -> None:
        """Connect the asset with an entity of the simulation."""
        self._env, self._entity = env, entity
        self._drives: dict[str, JointDrive] = {}
        self._wrench = BodyWrench(env, entity)
        self.data = Data(env, entity)
        self.joint_names, self.body_names = self.data.joint_names, self.data.body_names
        self.num_joints, self.num_bodies = len(self.joint_names), len(self.body_names)
        self.num_instances, self.device = env.num_envs, env.device
        self.is_fixed_base = not entity.is_floating
        self._ALL_INDICES = torch.arange(env.num_envs, device=env.device)
        self.root_physx_view = PhysxView(env, entity)

    @property
    def permanent_wrench_composer(self) -> BodyWrench:
        """Writer of forces on bodies, which act until they change."""
        return self._wrench

    instantaneous_wrench_composer = permanent_wrench_composer

    def set_external_force_and_torque(
        self, forces: Tensor, torques: Tensor, body_ids: Any = None, env_ids: Any = None, **frame: Any
    ) -> None:
        """Apply forces [N] and torques [N m] to bodies, in their own frames, until they change. (rows, bodies, 3)"""
        self._wrench.set_forces_and_torques(forces, torques, body_ids=body_ids, env_ids=env_ids, **frame)

    def apply_wrenches(self) -> None:
        """Write the forces on bodies for the next physics step."""
        self._wrench.apply()

    def reset(self, env_ids: Any = None) -> None:
        """Remove forces on bodies."""
        self._wrench.reset(env_ids)

    def set_joint_effort_target(self, target: Tensor, joint_ids: Any = None, env_ids: Any = None) -> None:
        """Set efforts of joints. (rows, joints) [N or N m]"""
        self._drive("motor").set(target, joint_ids, env_ids)

    def set_joint_position_target(self, target: Tensor, joint_ids: Any = None, env_ids: Any = None) -> None:
        """Set position targets of joints. (rows, joints) [m or rad]"""
        self._drive("position").set(target, joint_ids, env_ids)

    def set_joint_velocity_target(self, target: Tensor, joint_ids: Any = None, env_ids: Any = None) -> None:
        """Set velocity targets of joints. (rows, joints) [m/s or rad/s]"""
        self._drive("velocity").set(target, joint_ids, env_ids)

    def write_data_to_sim(self) -> None:
        """Do nothing: targets are written when they are set."""

    def update(self, dt: float) -> None:
        """Do nothing: data are computed when they are read."""

    def _drive(self, kind: str) -> JointDrive:
        if kind not in self._drives:
            self._drives[kind] = JointDrive(self._env, self._entity, kind)
        return self._drives[kind]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(name)
        known = [n for n in (*dir(type(self)), *vars(self)) if not n.startswith("_")]
        hint = did_you_mean(name, known) or f"attributes: {listing(known, 40)}"
        if "physx" in name and not did_you_mean(name, known):
            hint = "rlcli has no PhysX; use `data` and the randomization events"
        raise AttributeError(f"an asset has no '{name}'; {hint}")

    def find_joints(self, name_keys: Any, joint_subset: Any = None, preserve_order: bool = False) -> Any:
        """Return ids and names of the joints that names or regexes match."""
        return find_elements(name_keys, joint_subset or self.joint_names, self.joint_names, "joint", preserve_order)

    def find_bodies(self, name_keys: Any, preserve_order: bool = False) -> Any:
        """Return ids and names of the bodies that names or regexes match."""
        return find_elements(name_keys, self.body_names, self.body_names, "body", preserve_order)

    def write_joint_state_to_sim(
        self, position: Tensor, velocity: Tensor, joint_ids: Any = None, env_ids: Any = None
    ) -> None:
        """Set positions and velocities of joints. (rows, joints) each [m or rad, m/s or rad/s]"""
        self._write("qpos", self._entity.qpos_columns, position, joint_ids, env_ids)
        self._write("qvel", self._entity.dof_columns, velocity, joint_ids, env_ids)

    def write_joint_position_to_sim(self, position: Tensor, joint_ids: Any = None, env_ids: Any = None) -> None:
        """Set positions of joints. (rows, joints) [m or rad]"""
        self._write("qpos", self._entity.qpos_columns, position, joint_ids, env_ids)

    def write_joint_velocity_to_sim(self, velocity: Tensor, joint_ids: Any = None, env_ids: Any = None) -> None:
        """Set velocities of joints. (rows, joints) [m/s or rad/s]"""
        self._write("qvel", self._entity.dof_columns, velocity, joint_ids, env_ids)

    def write_root_pose_to_sim(self, root_pose: Tensor, env_ids: Any = None) -> None:
        """Set the root's position [m] and quaternion (w, x, y, z). (rows, 7)"""
        if not self._entity.is_floating:
            self._require_same_base(root_pose, env_ids)
            return
        root, _ = self._entity.floating()
        columns = torch.arange(root, root + 7, device=self._env.device)
        self._write("qpos", columns, root_pose, None, env_ids)

    def write_root_velocity_to_sim(self, root_velocity: Tensor, env_ids: Any = None) -> None:
        """Set the root's linear [m/s] and angular [rad/s] velocity, world frame. Set the pose first. (rows, 6)"""
        if not self._entity.is_floating:
            return  # a fixed base does not move
        root, dof = self._entity.floating()
        rows = slice(None) if env_ids is None else env_ids
        quat = self._env.engine.field("qpos")[rows, root + 3 : root + 7].float()
        # qvel of a free joint: linear velocity in the world frame, angular velocity in the body frame
        local = rotate_inverse(quat, root_velocity[:, 3:])
        columns = torch.arange(dof, dof + 6, device=self._env.device)
        self._write("qvel", columns, torch.cat([root_velocity[:, :3], local], dim=1), None, env_ids)

    def write_root_state_to_sim(self, root_state: Tensor, env_ids: Any = None) -> None:
        """Set the root's pose and velocity, world frame. (rows, 13)"""
        self.write_root_pose_to_sim(root_state[:, :7], env_ids)
        self.write_root_velocity_to_sim(root_state[:, 7:], env_ids)

    write_root_link_pose_to_sim, write_root_com_velocity_to_sim = write_root_pose_to_sim, write_root_velocity_to_sim
    write_root_link_state_to_sim, write_root_link_velocity_to_sim = write_root_state_to_sim, write_root_velocity_to_sim

    def _require_same_base(self, root_pose: Tensor, env_ids: Any) -> None:
        """Check that the pose of a fixed base does not change."""
        rows = slice(None) if env_ids is None else env_ids
        now = self.data.root_pos_w[rows]
        if not torch.allclose(root_pose[:, :3], now, atol=1e-4):
            raise TaskError(
                f"the base of '{self._entity.name}' is fixed in its MJCF, and the task moves it",
                hint="add a <freejoint/> to the MJCF, or remove the change of the root's position",
            )

    def _write(self, field: str, columns: Tensor, values: Tensor, joint_ids: Any, env_ids: Any) -> None:
        target = self._env.engine.field(field)
        columns = columns if joint_ids is None else columns[joint_ids].reshape(-1)
        rows = torch.arange(len(target), device=target.device) if env_ids is None else torch.as_tensor(env_ids)
        target[rows[:, None], columns] = values.to(target.dtype)
        self._env.sim.refresh()


class Scene(Mapping[str, Any]):
    """Assets and sensors by name."""

    def __init__(self, env: VecEnv) -> None:
        self._env = env
        self.articulations = {name: Asset.of(env, entity) for name, entity in env.entities.items()}
        self.rigid_objects = {name: a for name, a in self.articulations.items() if not a.joint_names}

        self._frames: dict[str, FrameTransformer] = {}
        self.user_cfg: Any = None
        self.looks: dict[str, Any] = {}
        """Lights and other assets that only change how a scene looks."""

    def add_frames(self, frames: Mapping[str, Any]) -> None:
        """Add frame transformers by their settings (`sensor_reader.py`), and lights, which have none."""
        for name, settings in frames.items():
            if settings is None:
                self.looks[name] = SimpleNamespace(
                    prims=[NoEffect(f"the light '{name}'")], body_names=[], joint_names=[]
                )
                continue
            self._frames.setdefault(name, FrameTransformer(self.articulations, settings))

    @property
    def sensors(self) -> Mapping[str, Any]:
        """Sensors by name."""
        sensors = getattr(self._env, "sensors", {}).items()
        found = {name: camera_or_sensor(sensor) for name, sensor in sensors} | self._frames
        for name, made in found.items():
            made.cfg = getattr(self.user_cfg, name, None)
        return found

    def clone_environments(self, *args: Any, **options: Any) -> None:
        """Do nothing: every environment has its own simulation."""

    filter_collisions = clone_environments

    @property
    def cfg(self) -> Any:
        """Settings of the scene: the user's object, or rlcli's without one."""
        return self._env.config.scene if self.user_cfg is None else self.user_cfg

    @property
    def num_envs(self) -> int:
        """Number of environments."""
        return self._env.num_envs

    @property
    def env_origins(self) -> Tensor:
        """Start position of each environment in the world frame; 0 without a terrain. (num_envs, 3) [m]"""
        origins = getattr(self._env, "origins", None)
        return torch.zeros(self._env.num_envs, 3, device=self._env.device) if origins is None else origins

    @property
    def terrain(self) -> Any:
        """Terrain, or None."""
        terrain = getattr(self._env, "terrain", None)
        if terrain is None:
            return None
        made = bound(TerrainImporter, self._env, terrain)
        if hasattr(self.user_cfg, "terrain"):
            made.cfg = self.user_cfg.terrain
        return made

    def __getitem__(self, name: str) -> Any:
        if name in self.articulations:
            return self.articulations[name]
        sensors = self.sensors
        if name in sensors:
            return sensors[name]
        if name == "terrain" and self.terrain is not None:
            return self.terrain
        if name in self.looks:
            return self.looks[name]
        raise KeyError(f"no '{name}' in the scene; entities and sensors: {listing([*self.articulations, *sensors])}")

    def __iter__(self) -> Iterator[str]:
        return iter([*self.articulations, *self.sensors, *self.looks])

    def __len__(self) -> int:
        return len(self.articulations) + len(self.sensors) + len(self.looks)

    def resolve(self, cfg: Any) -> None:
        """Resolve the names of a `SceneEntityCfg` to ids.

        Raises:
            NameProblem: if a name matches nothing.
        """
        if cfg.name not in self:
            hint = did_you_mean(cfg.name, list(self)) or f"entities and sensors: {listing(self)}"
            raise NameProblem(f"no '{cfg.name}' in the scene", hint)
        element = self[cfg.name]
        for kind in ("joint", "body"):
            wanted = getattr(cfg, f"{kind}_names")
            if wanted is None:
                continue
            names = getattr(element, f"{kind}_names")
            ids, matched = find_elements(wanted, names, names, kind, cfg.preserve_order)
            all_selected = ids == list(range(len(names)))
            setattr(cfg, f"{kind}_names", matched)
            setattr(cfg, f"{kind}_ids", slice(None) if all_selected else torch.tensor(ids, device=self._env.device))

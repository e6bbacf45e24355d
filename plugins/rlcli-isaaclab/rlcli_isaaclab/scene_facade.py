"""Assets, sensors and the scene as Isaac Lab's terms expect them: `env.scene["robot"].data.joint_pos`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.errors import TaskError, did_you_mean, listing
from rlcli.scene.entity import Entity
from rlcli.scene.names import NameProblem
from rlcli.sim.rotations import conjugate, multiply, rotate, rotate_inverse
from rlcli_isaaclab.asset_commands import BodyWrench, JointDrive, PhysxView
from rlcli_isaaclab.asset_data import Data
from rlcli_isaaclab.missing_names import MissingMemberError, NoEffect, absence, report_once
from rlcli_isaaclab.sensor_facade import FrameTransformer, TerrainImporter, bound, camera_or_sensor, find_elements
from rlcli_isaaclab.sensor_reader import filter_name
from rlcli_isaaclab.setup_scene import current_setup

_OWN_CLASS = (
    "if an asset class of your task defines this attribute, compute the value in a term:"
    " rlcli does not run methods of a task's asset classes"
)


class Asset:
    """A robot or object of the scene, with the attributes and methods of Isaac Lab's assets.

    In all methods, `env_ids` are the environments of the rows of a tensor, and `joint_ids` the joints of its columns;
    None means all of them.
    """

    def __init__(self, cfg: Any) -> None:
        current_setup().add(self, cfg)

    @classmethod
    def of(cls, env: VecEnv, entity: Entity) -> Asset:
        """Return the asset that reads and writes an entity of the simulation."""
        asset = cls.__new__(cls)
        asset.cfg = entity.config
        asset.bind(env, entity)
        return asset

    cfg: Any

    def bind(self, env: VecEnv, entity: Entity) -> None:
        """Connect the asset with the entity of the simulation that it reads and writes."""
        self._env, self._entity = env, entity
        self._drives: dict[str, JointDrive] = {}
        self._wrench = BodyWrench(env, entity)
        self.data = Data(env, entity)
        self.joint_names, self.body_names = self.data.joint_names, self.data.body_names
        self.num_joints, self.num_bodies = len(self.joint_names), len(self.body_names)
        self.num_instances, self.device = env.num_envs, env.device
        self.is_fixed_base = not entity.is_floating
        self._ALL_INDICES = torch.arange(env.num_envs, device=env.device)
        self.root_physx_view = self._physics_sim_view = PhysxView(env, entity)

    @property
    def _data(self) -> Data:
        """Isaac Lab's private name of `data`, which tasks read too."""
        return self.data

    @property
    def permanent_wrench_composer(self) -> BodyWrench:
        """Writer of forces and torques on bodies. They act in every physics step until they are changed."""
        return self._wrench

    instantaneous_wrench_composer = permanent_wrench_composer

    @property
    def _external_force_b(self) -> Tensor:
        """Forces that the task applies to the bodies, in the frame of each body. (num_envs, bodies, 3) [N]"""
        return self._wrench.local[..., :3]

    @_external_force_b.setter
    def _external_force_b(self, value: Tensor) -> None:
        self._wrench.local[..., :3] = value

    @property
    def _external_torque_b(self) -> Tensor:
        """Torques that the task applies to the bodies, in the frame of each body. (num_envs, bodies, 3) [N m]"""
        return self._wrench.local[..., 3:]

    @_external_torque_b.setter
    def _external_torque_b(self, value: Tensor) -> None:
        self._wrench.local[..., 3:] = value

    def set_external_force_and_torque(
        self, forces: Tensor, torques: Tensor, body_ids: Any = None, env_ids: Any = None, **frame: Any
    ) -> None:
        """Apply forces [N] and torques [N m] to bodies until the next call. (rows, bodies, 3) each

        The vectors are in the frames of the bodies; with `is_global=True` in `frame` they are in the world frame.
        """
        self._wrench.set_forces_and_torques(forces, torques, body_ids=body_ids, env_ids=env_ids, **frame)

    def start_wrenches(self, by_task: bool = False) -> None:
        """Begin to apply forces on bodies before each physics step.

        With `by_task` the task's own code calls `apply_wrenches` before each physics step.
        """
        self._wrench.is_applied |= by_task
        self._wrench.start()

    def apply_wrenches(self) -> None:
        """Write the forces on bodies for the next physics step."""
        self._wrench.apply()

    def reset(self, env_ids: Any = None) -> None:
        """Remove the forces and torques on bodies in the environments `env_ids`; None: in all."""
        self._wrench.reset(env_ids)

    def set_joint_effort_target(self, target: Tensor, joint_ids: Any = None, env_ids: Any = None) -> None:
        """Set the efforts that motors apply to joints. (rows, joints) [N or N m]"""
        self._drive("motor").set(target, joint_ids, env_ids)

    def set_joint_position_target(self, target: Tensor, joint_ids: Any = None, env_ids: Any = None) -> None:
        """Set position targets of joints. (rows, joints) [m or rad]"""
        self._drive("position").set(target, joint_ids, env_ids)

    def set_joint_velocity_target(self, target: Tensor, joint_ids: Any = None, env_ids: Any = None) -> None:
        """Set velocity targets of joints. (rows, joints) [m/s or rad/s]"""
        self._drive("velocity").set(target, joint_ids, env_ids)

    def write_data_to_sim(self) -> None:
        """Do nothing: the methods that set targets write them into the simulation at once."""

    def state(self) -> dict[str, Tensor]:
        """Return the tensors, by name, that a checkpoint must contain besides the state of the simulation."""
        return {}

    def update(self, dt: float) -> None:
        """Do nothing: the members of `data` are computed when they are read."""

    def _drive(self, kind: str) -> JointDrive:
        if kind not in self._drives:
            self._drives[kind] = JointDrive(self._env, self._entity, kind)
        return self._drives[kind]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name.startswith("_"):
            raise MissingMemberError(
                f"an asset of rlcli has no private attribute '{name}'; use public attributes", _OWN_CLASS
            )
        known = [n for n in (*dir(type(self)), *vars(self)) if not n.startswith("_")]
        hint = did_you_mean(name, known) or f"attributes: {listing(known, 40)}"
        if "physx" in name and not did_you_mean(name, known):
            hint = "rlcli has no PhysX; use `data` and the randomisation events"
        if "tendon" in name or name.startswith("write_joint_"):
            raise absence(f"Articulation.{name}", hint="use a randomisation event, or set the value in the MJCF")
        raise MissingMemberError(f"an asset has no '{name}'; {hint}", _OWN_CLASS)

    def find_joints(self, name_keys: Any, joint_subset: Any = None, preserve_order: bool = False) -> Any:
        """Return (indices, names) of the joints whose names match `name_keys`, names or regexes."""
        return find_elements(name_keys, joint_subset or self.joint_names, self.joint_names, "joint", preserve_order)

    def find_bodies(self, name_keys: Any, preserve_order: bool = False) -> Any:
        """Return (indices, names) of the bodies whose names match `name_keys`, names or regexes."""
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
        """Set the root's position [m] and quaternion (w, x, y, z), world frame. (rows, 7)

        A fixed root is not moved: another position is an error, and another orientation is reported once.
        """
        if self._entity.mocap >= 0:
            mocap = torch.tensor([self._entity.mocap], device=self._env.device)
            self._write("mocap_pos", mocap, root_pose[:, None, :3], None, env_ids)
            self._write("mocap_quat", mocap, root_pose[:, None, 3:], None, env_ids)
            return
        if not self._entity.is_floating:
            self._require_same_base(root_pose, env_ids)
            return
        root, _ = self._entity.floating()
        columns = torch.arange(root, root + 7, device=self._env.device)
        self._write("qpos", columns, root_pose, None, env_ids)

    def write_root_velocity_to_sim(self, root_velocity: Tensor, env_ids: Any = None) -> None:
        """Set velocities of the root's centre of mass [m/s] and angular velocities [rad/s], world frame. (rows, 6)

        Set the pose first.
        """
        if not self._entity.is_floating:
            return  # a fixed base does not move, and MuJoCo's mocap bodies (kinematic ones) have no velocity
        root, _ = self._entity.floating()
        rows = slice(None) if env_ids is None else env_ids
        quat = self._env.engine.field("qpos")[:, root + 3 : root + 7].float()
        angular = torch.zeros_like(quat[:, :3])
        angular[rows] = rotate_inverse(quat[rows], root_velocity[:, 3:])
        linear = root_velocity[:, :3] - self._entity.com_velocity(quat, angular)[rows]
        self.write_root_link_velocity_to_sim(torch.cat([linear, root_velocity[:, 3:]], dim=1), env_ids)

    def write_root_link_velocity_to_sim(self, root_velocity: Tensor, env_ids: Any = None) -> None:
        """Set velocities of the root's origin [m/s] and angular velocities [rad/s], world frame. (rows, 6)

        Set the pose first.
        """
        if not self._entity.is_floating:
            return
        root, dof = self._entity.floating()
        rows = slice(None) if env_ids is None else env_ids
        quat = self._env.engine.field("qpos")[rows, root + 3 : root + 7].float()
        # qvel of a free joint: linear velocity in the world frame, angular velocity in the body frame
        local = rotate_inverse(quat, root_velocity[:, 3:])
        columns = torch.arange(dof, dof + 6, device=self._env.device)
        self._write("qvel", columns, torch.cat([root_velocity[:, :3], local], dim=1), None, env_ids)

    def write_root_state_to_sim(self, root_state: Tensor, env_ids: Any = None) -> None:
        """Set the root's pose, and the velocity of its centre of mass, world frame. (rows, 13)"""
        self.write_root_pose_to_sim(root_state[:, :7], env_ids)
        self.write_root_velocity_to_sim(root_state[:, 7:], env_ids)

    def write_root_link_state_to_sim(self, root_state: Tensor, env_ids: Any = None) -> None:
        """Set the root's pose, and the velocity of its origin, world frame. (rows, 13)"""
        self.write_root_pose_to_sim(root_state[:, :7], env_ids)
        self.write_root_link_velocity_to_sim(root_state[:, 7:], env_ids)

    write_root_link_pose_to_sim, write_root_com_velocity_to_sim = write_root_pose_to_sim, write_root_velocity_to_sim

    def write_root_com_pose_to_sim(self, root_pose: Tensor, env_ids: Any = None) -> None:
        """Set the position of the root's centre of mass [m], and its principal axes (w, x, y, z). (rows, 7)"""
        rows = slice(None) if env_ids is None else env_ids
        quat = multiply(root_pose[:, 3:], conjugate(self.data.body_com_quat_b[rows, 0]))
        position = root_pose[:, :3] - rotate(quat, self.data.body_com_pos_b[rows, 0])
        self.write_root_pose_to_sim(torch.cat([position, quat], dim=1), env_ids)

    def write_root_com_state_to_sim(self, root_state: Tensor, env_ids: Any = None) -> None:
        """Set the pose and the velocity of the root's centre of mass, world frame. (rows, 13)"""
        self.write_root_com_pose_to_sim(root_state[:, :7], env_ids)
        self.write_root_velocity_to_sim(root_state[:, 7:], env_ids)

    def _require_same_base(self, root_pose: Tensor, env_ids: Any) -> None:
        """Raise a TaskError if the task moves a base that is fixed in the MJCF."""
        rows = slice(None) if env_ids is None else env_ids
        now = self.data.root_pos_w[rows]
        if not torch.allclose(root_pose[:, :3], now, atol=1e-4):
            raise TaskError(
                f"the base of '{self._entity.name}' is fixed in its MJCF, and the task moves it",
                hint='add <freejoint/> to its body in the MJCF, or mocap="true" if only a reset moves it',
            )
        turned = torch.nn.functional.normalize(root_pose[:, 3:])
        cosine = (turned * self.data.root_quat_w[rows]).sum(dim=1).abs()  # of half the angle
        if not bool((cosine > 1.0 - 1e-6).all()):
            name = self._entity.name
            report_once(f"the base of '{name}' is fixed in its MJCF: the orientation that the task sets is ignored")

    def _write(self, field: str, columns: Tensor, values: Tensor, joint_ids: Any, env_ids: Any) -> None:
        target = self._env.engine.field(field)
        columns = columns if joint_ids is None else columns[joint_ids].reshape(-1)
        rows = torch.arange(len(target), device=target.device) if env_ids is None else torch.as_tensor(env_ids)
        target[rows[:, None], columns] = values.to(target.dtype)
        self._env.sim.refresh()


class Scene(Mapping[str, Any]):
    """Mapping from names to the assets and sensors of the scene, as `env.scene` in Isaac Lab."""

    def __init__(self, env: VecEnv) -> None:
        self._env = env
        self.articulations = {name: Asset.of(env, entity) for name, entity in env.entities.items()}
        self.rigid_objects = {name: a for name, a in self.articulations.items() if not a.joint_names}

        self.collections: dict[str, Any] = {}
        self._frames: dict[str, FrameTransformer] = {}
        self.user_cfg: Any = None
        self.looks: dict[str, Any] = {}
        """Lights and other assets that only change how a scene looks."""

    def add_frames(self, frames: Mapping[str, Any]) -> None:
        """Add frame transformers and lights by name.

        The settings of a frame transformer come from `sensor_reader.py`; a light has None.
        """
        for name, settings in frames.items():
            if settings is None:
                self.looks[name] = SimpleNamespace(
                    prims=[NoEffect(f"the light '{name}'")], body_names=[], joint_names=[]
                )
                continue
            self._frames.setdefault(name, FrameTransformer(self.articulations, settings))

    def add_collections(self, cfg: Any) -> None:
        """Add the collections of rigid objects that `cfg`, the user's configuration of the scene, has."""
        from rlcli_isaaclab.collection import RigidObjectCollection, entity_name

        for name, settings in vars(cfg).items():
            parts = getattr(settings, "rigid_objects", None)
            if parts and name not in self.collections:
                objects = {part: self.articulations[entity_name(name, part)] for part in parts}
                self.collections[name] = RigidObjectCollection(settings, objects)

    @property
    def sensors(self) -> Mapping[str, Any]:
        """Sensors of the simulation and frame transformers, by name."""
        sensors = getattr(self._env, "sensors", {}).items()
        found = {name: camera_or_sensor(name, dict(sensors)) for name, _ in sensors} | self._frames
        for name, made in found.items():
            made.cfg = getattr(self.user_cfg, name, None)
            made.filters = []
            while filter_name(name, len(made.filters)) in found:
                made.filters.append(found[filter_name(name, len(made.filters))])
        return found

    def write_data_to_sim(self) -> None:
        """Do nothing: targets are written when they are set."""

    def update(self, dt: float) -> None:
        """Do nothing: data are computed when they are read."""

    def reset(self, env_ids: Any = None) -> None:
        """Remove the forces on all bodies in the environments `env_ids`; None: in all environments."""
        for asset in self.articulations.values():
            asset.reset(env_ids)

    def clone_environments(self, *args: Any, **options: Any) -> None:
        """Do nothing: every environment has its own simulation."""

    filter_collisions = clone_environments

    @property
    def cfg(self) -> Any:
        """Settings of the scene: the user's configuration object; without such an object, rlcli's settings."""
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
        """Terrain. None for a scene without one; for a plane an object that only has `cfg` and `env_origins`."""
        terrain, cfg = getattr(self._env, "terrain", None), getattr(self.user_cfg, "terrain", None)
        if terrain is None and cfg is None:
            return None
        made = bound(TerrainImporter, self._env, terrain)
        if cfg is not None:
            made.cfg = cfg
        return made

    def __getitem__(self, name: str) -> Any:
        if name in self.articulations:
            return self.articulations[name]
        if name in self.collections:
            return self.collections[name]
        sensors = self.sensors
        if name in sensors:
            return sensors[name]
        if name == "terrain" and self.terrain is not None:
            return self.terrain
        if name in self.looks:
            return self.looks[name]
        raise KeyError(f"no '{name}' in the scene; entities and sensors: {listing([*self.articulations, *sensors])}")

    def __iter__(self) -> Iterator[str]:
        return iter([*self.articulations, *self.collections, *self.sensors, *self.looks])

    def __len__(self) -> int:
        return len(list(iter(self)))

    def resolve(self, cfg: Any) -> None:
        """Write into a `SceneEntityCfg` the indices of the joints and bodies that its names select.

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
            # as in Isaac Lab, a regex that matches all names gives a list of ids, and a list of all names a slice
            is_slice = not isinstance(wanted, str) and list(wanted) == list(names)
            setattr(cfg, f"{kind}_names", matched)
            setattr(cfg, f"{kind}_ids", slice(None) if is_slice else torch.tensor(ids, device=self._env.device).long())

"""A robot or object of the scene: its elements by name, its state as float32 tensors, and how to set it."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Hashable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli.config.schema import EntityConfig
from rlcli.errors import TaskError
from rlcli.sim.engine import Engine, computes_body_forces
from rlcli.sim.names import NameProblem, match
from rlcli.sim.rotations import atan2, axis_x, length, multiply, rotate, rotate_inverse, wrap_to_pi
from rlcli.sim.scene import actuator_kind, joint_settings
from rlcli.sim.selection import ALL, Columns, Field, Selection, ids_of

if TYPE_CHECKING:
    from rlcli.sim.actuators import ActuatorModel

_MOST_PARTS = 256
"""Indices of which an entity's views are kept: those of a configuration are few."""
_SCALAR = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
Value = TypeVar("Value")


class SimData:
    """The engine's joint state as float32, copied once a step, and derived fields cast when read.

    `qpos` (num_envs, nq) and `qvel` (num_envs, nv) keep their storage for ever, so views of them stay valid. Where the
    engine keeps the two side by side they are one copy; where its own are float32, they are the engine's own.
    """

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        qpos, qvel = engine.field("qpos"), engine.field("qvel")
        joined = _joined(qpos, qvel)
        self._sources = [qpos, qvel] if joined is None else [joined]
        self._copies = [source.to(torch.float32).contiguous() for source in self._sources]
        self._flat = [copy.view(-1) for copy in self._copies]
        own = self._copies[0] is self._sources[0]
        # an engine in float64 is on the CPU, where small copies cost numpy half of torch's
        pairs = [] if own else zip(self._copies, self._sources, strict=True)
        self._stale = [(copy.numpy(), source.numpy()) for copy, source in pairs]
        self._good = [copy.copy() for copy, _ in self._stale]
        self.qpos = self._copies[0][:, : qpos.shape[1]]
        self.qvel = self._copies[-1][:, -qvel.shape[1] :] if qvel.shape[1] else self._copies[-1][:, :0]
        self.stamp = 0
        self._kept_at, self._summed = -1, (-1, 0.0)
        self._moved: Selection | None = None
        self._derived: dict[str, tuple[int, Tensor]] = {}

    def moved(self, selection: Selection) -> None:
        """The selected worlds have been put elsewhere: what derives from their state is that of the new one.

        An engine that computes all worlds at once does so when it is next read: once, however often worlds move.
        """
        if not self.engine.asynchronous:
            self.engine.forward(selection)
        else:
            self._moved = selection if self._moved is None else self._moved.joined(selection)
        self.refresh_rows(selection)

    def settle(self) -> None:
        """Compute what is left to compute of worlds that have moved."""
        if self._moved is not None:
            selection, self._moved = self._moved, None
            self.engine.forward(selection)

    def refresh(self) -> None:
        """Copy the state of every world."""
        for copy, source in self._stale:
            copy[...] = source
        self.stamp += 1

    def refresh_rows(self, selection: Selection) -> None:
        """Copy the state of the selected worlds, and drop what was computed from it."""
        for copy, source in self._stale:
            rows = ids_of(selection)
            copy[rows] = source[rows]
        self.stamp += 1

    def keep(self) -> None:
        """Note that the state as it is here is one to go back to."""
        if self._kept_at == self.stamp:
            return
        self._kept_at = self.stamp
        for good, (copy, _) in zip(self._good, self._stale, strict=True):
            good[...] = copy

    def restore_rows(self, selection: Selection) -> None:
        """Write the last state of the selected worlds that was kept back to the engine."""
        for good, (_, source) in zip(self._good, self._stale, strict=True):
            rows = ids_of(selection)
            source[rows] = good[rows]

    def is_finite(self) -> bool:
        """Whether every position and velocity is a finite number, as the last `refresh` found them."""
        return math.isfinite(self._squares()) or all(bool(flat.isfinite().all()) for flat in self._flat)

    def out_of_bounds(self, limit: float) -> Tensor | None:
        """Worlds with a position or a velocity that is not finite or beyond `limit`; None for none. (num_envs,) bool"""
        # the sum of all squares bounds each of them, is not finite where one is not, and rounds by far less than half
        if self._squares() <= 0.5 * limit * limit:
            return None
        bad = [~(copy.abs() <= limit).all(dim=1) for copy in self._copies]
        return torch.stack(bad).any(dim=0)

    def _squares(self) -> float:
        at, total = self._summed
        if at != self.stamp:
            total = 0.0
            for flat in self._flat:
                total += torch.dot(flat, flat).item()
            self._summed = self.stamp, total
        return total

    def derived(self, name: str) -> Tensor:
        """A derived field as float32, cast once a step. (num_envs, ...)"""
        self.settle()
        stamp, value = self._derived.get(name, (-1, None))
        if stamp != self.stamp or value is None:
            value = self.engine.field(name).float()
            self._derived[name] = (self.stamp, value)
        return value


class Entity:
    """One attached model. Joints are its hinges and slides in the model's order; a free joint is its root."""

    def __init__(self, name: str, config: EntityConfig, engine: Engine, sim: SimData) -> None:
        self.name = name
        self.config = config
        self.engine = engine
        self.sim = sim
        model = engine.model
        self.joint_ids = _ids(
            model, name, mujoco.mjtObj.mjOBJ_JOINT, model.njnt, lambda j: model.jnt_type[j] in _SCALAR
        )
        self.body_ids = _ids(model, name, mujoco.mjtObj.mjOBJ_BODY, model.nbody)
        self.site_ids = _ids(model, name, mujoco.mjtObj.mjOBJ_SITE, model.nsite)
        self.sensor_ids = _ids(model, name, mujoco.mjtObj.mjOBJ_SENSOR, model.nsensor)
        self.actuator_ids = _ids(model, name, mujoco.mjtObj.mjOBJ_ACTUATOR, model.nu)
        self.geom_ids = _ids(model, name, mujoco.mjtObj.mjOBJ_GEOM, model.ngeom)
        self.tendon_ids = _ids(model, name, mujoco.mjtObj.mjOBJ_TENDON, model.ntendon)
        self.pair_ids = _ids(model, name, mujoco.mjtObj.mjOBJ_PAIR, model.npair)
        self.names: dict[str, list[str]] = {
            "Joints": _names(model, name, mujoco.mjtObj.mjOBJ_JOINT, self.joint_ids),
            "Bodies": _names(model, name, mujoco.mjtObj.mjOBJ_BODY, self.body_ids),
            "Sites": _names(model, name, mujoco.mjtObj.mjOBJ_SITE, self.site_ids),
            "Sensors": _names(model, name, mujoco.mjtObj.mjOBJ_SENSOR, self.sensor_ids),
            "Actuators": _names(model, name, mujoco.mjtObj.mjOBJ_ACTUATOR, self.actuator_ids),
            "Geoms": _names(model, name, mujoco.mjtObj.mjOBJ_GEOM, self.geom_ids),
            "Tendons": _names(model, name, mujoco.mjtObj.mjOBJ_TENDON, self.tendon_ids),
            "Pairs": _names(model, name, mujoco.mjtObj.mjOBJ_PAIR, self.pair_ids),
        }
        self.joint_names = self.names["Joints"]
        self.qpos_columns = torch.from_numpy(model.jnt_qposadr[self.joint_ids].astype(np.int64)).to(engine.device)
        self.dof_columns = torch.from_numpy(model.jnt_dofadr[self.joint_ids].astype(np.int64)).to(engine.device)
        self.root_body = int(self.body_ids[0]) if len(self.body_ids) else 0
        self.root_qpos, self.root_dof = self._root(model)
        self.mocap = int(model.body_mocapid[self.root_body])
        """Number of the mocap body that the root is; -1: none."""
        self._qpos, self._qvel = engine.field("qpos"), engine.field("qvel")
        self._places: dict[tuple, tuple[Columns, Field, Columns]] = {}
        self.data = EntityData(self, sim)
        self.actuators: list[ActuatorModel] = []
        """Models that drive joints between physics steps; filled once the entity stands."""

    @property
    def is_floating(self) -> bool:
        """Whether the root is a free joint."""
        return self.root_qpos is not None

    def select(self, alias: str, patterns: str | Sequence[str]) -> tuple[Columns, list[str]]:
        """Names or regexes of Joints, Bodies, ... -> an index into this entity's columns, and the names it stands for.

        Raises:
            NameProblem: for what the model does not have.
        """
        names = self.names[alias]
        singular = {"Bodies": "body"}.get(alias, alias[:-1].lower())
        positions = match(patterns, names, singular)
        if alias == "Sensors":
            return self._index(self._sensor_columns(positions)), [names[p] for p in positions]
        return self._index(positions), [names[p] for p in positions]

    def actuators_of(self, kind: str) -> list[tuple[int, int]]:
        """(joint column, actuator id) of every joint that a motor, position or velocity actuator drives."""
        model = self.engine.model
        found = []
        for a in self.actuator_ids.tolist():
            made = actuator_kind(
                model.actuator_trntype[a],
                model.actuator_dyntype[a],
                model.actuator_gaintype[a],
                model.actuator_biastype[a],
                model.actuator_gainprm[a],
                model.actuator_biasprm[a],
            )
            joint = int(model.actuator_trnid[a, 0])
            if made == kind and joint in self.joint_ids:
                found.append((self.joint_ids.tolist().index(joint), a))
        return sorted(found)

    def write_joint_positions(self, selection: Selection, values: Tensor, joints: Columns = ALL) -> None:
        """Set joint positions of the selected environments. values (rows, k) [m or rad]"""
        field, columns = self._place(self._qpos, self.qpos_columns, joints)
        selection.write(field, values, columns)

    def write_joint_velocities(self, selection: Selection, values: Tensor, joints: Columns = ALL) -> None:
        """Set joint velocities of the selected environments. values (rows, k) [m/s or rad/s]"""
        field, columns = self._place(self._qvel, self.dof_columns, joints)
        selection.write(field, values, columns)

    def write_root_pose(self, selection: Selection, position: Tensor, quat: Tensor) -> None:
        """Set the pose of a free or mocap root in its world. position (rows, 3) [m], quat (rows, 4) w, x, y, z"""
        if self.mocap >= 0:
            selection.write(self.engine.field("mocap_pos")[:, self.mocap], position)
            selection.write(self.engine.field("mocap_quat")[:, self.mocap], quat)
            return
        root, _ = self.floating()
        selection.write(self._qpos, torch.cat([position, quat], dim=1), slice(root, root + 7))

    def write_root_velocity(self, selection: Selection, linear_w: Tensor, angular_w: Tensor) -> None:
        """Set the root's velocity, world frame; set the pose first. linear [m/s] and angular [rad/s], (rows, 3) each"""
        root, dof = self.floating()
        quat = selection.read(self._qpos, slice(root + 3, root + 7)).float()
        local = rotate_inverse(quat, angular_w)  # a free joint's angular velocity is in the body's frame
        selection.write(self._qvel, torch.cat([linear_w, local], dim=1), slice(dof, dof + 6))

    def read_root_velocity(self, selection: Selection) -> tuple[Tensor, Tensor]:
        """The root's velocity as it is now, also where it has just been set, world frame. (rows, 3) each"""
        qpos, dof = self.floating()
        velocity = selection.read(self._qvel, slice(dof, dof + 6)).float()
        quat = selection.read(self._qpos, slice(qpos + 3, qpos + 7)).float()
        return velocity[:, :3], rotate(quat, velocity[:, 3:])

    def floating(self) -> tuple[int, int]:
        """Where the free joint of the root lies in qpos and in qvel.

        Raises:
            TaskError: if the root is fixed to the world.
        """
        if self.root_qpos is None or self.root_dof is None:
            raise TaskError(f"entity '{self.name}' is fixed to the world and cannot be moved")
        return self.root_qpos, self.root_dof

    def _index(self, positions: Sequence[int]) -> Columns:
        return as_index(positions, self.engine.device)

    def _place(self, field: Tensor, of: Tensor, joints: Columns) -> tuple[Field, Columns]:
        """Where in a field of the engine joints lie: of consecutive columns the part that is these alone."""
        key = (id(of), joints.start, joints.stop, joints.step) if isinstance(joints, slice) else (id(of), id(joints))
        if key not in self._places:
            columns = self._index(of[joints].tolist())
            part = (
                (self.engine.as_field(field[:, columns]), ALL)
                if isinstance(columns, slice)
                else (self.engine.as_field(field), columns)
            )
            # the joints stay referenced, so that their id is not given to another tensor
            self._places[key] = (joints, *part)
        return self._places[key][1:]

    def _sensor_columns(self, positions: Sequence[int]) -> list[int]:
        model = self.engine.model
        sensors = self.sensor_ids[list(positions)]
        return [c for s in sensors for c in range(model.sensor_adr[s], model.sensor_adr[s] + model.sensor_dim[s])]

    def _root(self, model: mujoco.MjModel) -> tuple[int | None, int | None]:
        joint = int(model.body_jntadr[self.root_body])
        if joint < 0 or model.jnt_type[joint] != int(mujoco.mjtJoint.mjJNT_FREE):
            return None, None
        return int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])


class EntityData:
    """The state of an entity in every environment, float32, positions in the environment's frame.

    Read it, do not write it: most attributes are live views. Setters are methods of `Entity`.
    """

    def __init__(self, entity: Entity, sim: SimData) -> None:
        self._entity = entity
        self._sim = sim
        self._cache: dict[Hashable, tuple[int, Tensor]] = {}
        self._pos, self._vel, self._default_pos, self._default_vel = _Parts(), _Parts(), _Parts(), _Parts()
        self._limit_parts = {soft: (_Parts(), _Parts()) for soft in (False, True)}
        self._angles: dict[int, tuple[Columns, int, Tensor]] = {}
        self._defaults: dict[tuple[Any, ...], tuple[Tensor, Tensor, Field, Field]] = {}
        model, num_envs = entity.engine.model, entity.engine.num_envs
        device = entity.engine.device
        self._qpos_index = as_index(entity.qpos_columns.tolist(), device)
        self._dof_index = as_index(entity.dof_columns.tolist(), device)
        self._body_index = as_index(entity.body_ids.tolist(), device)
        # consecutive columns: a view of the copied state, made once
        self._joint_pos = sim.qpos[:, self._qpos_index] if isinstance(self._qpos_index, slice) else None
        self._joint_vel = sim.qvel[:, self._dof_index] if isinstance(self._dof_index, slice) else None
        ranges = torch.tensor(model.jnt_range[entity.joint_ids], dtype=torch.float32, device=device)
        limited = torch.tensor(model.jnt_limited[entity.joint_ids], dtype=torch.bool, device=device)
        infinite = torch.tensor([-torch.inf, torch.inf], device=device)
        self.joint_pos_limits = torch.where(limited[:, None], ranges, infinite)
        """Lower and upper limit of each joint, infinite where it has none. (k, 2) [m or rad]"""
        middle, half = (
            ranges.mean(dim=1),
            0.5 * entity.config.soft_joint_pos_limit_factor * (ranges[:, 1] - ranges[:, 0]),
        )
        soft = torch.stack([middle - half, middle + half], dim=1)
        self.soft_joint_pos_limits = torch.where(limited[:, None], soft, infinite)
        """The limits, drawn in by `soft_joint_pos_limit_factor`. (k, 2) [m or rad]"""
        self._limits = {
            soft: tuple(end[None] for end in limits.unbind(dim=1))
            for soft, limits in ((False, self.joint_pos_limits), (True, self.soft_joint_pos_limits))
        }
        self._limited = limited
        self._joint_index = as_index(entity.joint_ids.tolist(), device)
        self._infinite = infinite
        position, velocity = (values.to(device) for values in default_joint_state(entity))
        self.default_joint_pos = position.expand(num_envs, -1).clone()
        """Default joint positions. (num_envs, k) [m or rad]"""
        self.default_joint_vel = velocity.expand(num_envs, -1).clone()
        """Default joint velocities. (num_envs, k) [m/s or rad/s]"""
        self.default_root_state = self._default_root(model).to(device).expand(num_envs, -1).clone()
        """Default root pose and velocity: position, quat (w, x, y, z), linear, angular. (num_envs, 13)"""
        self.joint_vel_limits = torch.tensor(
            [joint_settings(entity.config, name).velocity_limit or math.inf for name in entity.joint_names],
            device=device,
        )
        """Speed limit of each joint, `velocity_limit`, infinite where it has none. (k,) [m/s or rad/s]"""
        self._gravity = torch.tensor(model.opt.gravity, dtype=torch.float32, device=device).expand(num_envs, -1)
        self._down = _direction(self._gravity)
        self._tree_root = torch.from_numpy(model.body_rootid[entity.body_ids].astype(np.int64)).to(device)
        self._site_index = as_index(entity.site_ids.tolist(), device)
        self._site_body = torch.from_numpy(model.site_bodyid[entity.site_ids].astype(np.int64)).to(device)
        self._site_quat = torch.tensor(model.site_quat[entity.site_ids], dtype=torch.float32, device=device)
        self._tree_root_of_sites = torch.from_numpy(
            model.body_rootid[model.site_bodyid[entity.site_ids]].astype(np.int64)
        ).to(device)
        self._computes_body_forces = computes_body_forces(model)
        self._drives = _Drives(entity)

    @property
    def joint_pos(self) -> Tensor:
        """Joint positions. (num_envs, k) [m or rad]"""
        if self._joint_pos is not None:
            return self._joint_pos
        return self._once("joint_pos", lambda: self._sim.qpos[:, self._qpos_index])

    @property
    def joint_vel(self) -> Tensor:
        """Joint velocities. (num_envs, k) [m/s or rad/s]"""
        if self._joint_vel is not None:
            return self._joint_vel
        return self._once("joint_vel", lambda: self._sim.qvel[:, self._dof_index])

    def joint_pos_of(self, joints: Columns) -> Tensor:
        """`joint_pos[:, joints]`, for what is read in every step: a view is made once. (num_envs, k) [m or rad]"""
        return self._pos.of(self.joint_pos if self._joint_pos is None else self._joint_pos, joints)

    def joint_vel_of(self, joints: Columns) -> Tensor:
        """`joint_vel[:, joints]`, likewise. (num_envs, k) [m/s or rad/s]"""
        return self._vel.of(self.joint_vel if self._joint_vel is None else self._joint_vel, joints)

    def default_joint_pos_of(self, joints: Columns) -> Tensor:
        """`default_joint_pos[:, joints]`, likewise. (num_envs, k) [m or rad]"""
        return self._default_pos.of(self.default_joint_pos, joints)

    def default_joint_vel_of(self, joints: Columns) -> Tensor:
        """`default_joint_vel[:, joints]`, likewise. (num_envs, k) [m/s or rad/s]"""
        return self._default_vel.of(self.default_joint_vel, joints)

    def read_default_joints(self, selection: Selection, joints: Columns = ALL) -> tuple[Tensor, Tensor]:
        """Default positions and velocities of some joints, for a moment as `peek`. (rows, k) each"""
        if not isinstance(joints, slice):
            return selection.peek(self.default_joint_pos, joints), selection.peek(self.default_joint_vel, joints)
        position, velocity = self.default_joint_pos, self.default_joint_vel
        key = (joints.start, joints.stop, joints.step)
        known = self._defaults.get(key)
        if known is None or known[0] is not position or known[1] is not velocity:
            as_field = self._entity.engine.as_field
            known = position, velocity, as_field(position[:, joints]), as_field(velocity[:, joints])
            self._defaults[key] = known
        return selection.peek(known[2]), selection.peek(known[3])

    def joint_limits_of(self, joints: Columns, soft: bool = False) -> tuple[Tensor, Tensor]:
        """`joint_limits` of some joints, likewise. (num_envs or 1, k) each"""
        low, high = self.joint_limits(soft)
        lows, highs = self._limit_parts[soft]
        return lows.of(low, joints), highs.of(high, joints)

    def joint_angle_of(self, joints: Columns) -> Tensor:
        """`joint_pos[:, joints]` wrapped to [-pi, pi], computed once a step: do not write to it. (num_envs, k) [rad]"""
        stamp, known = self._sim.stamp, self._angles.get(id(joints))
        if known is not None and known[0] is joints and known[1] == stamp:
            return known[2]
        angle = wrap_to_pi(self.joint_pos_of(joints))
        if len(self._angles) >= _MOST_PARTS:
            self._angles.clear()
        self._angles[id(joints)] = joints, stamp, angle
        return angle

    @property
    def joint_acc(self) -> Tensor:
        """Joint accelerations over the last substep. (num_envs, k) [m/s^2 or rad/s^2]"""
        return self._sim.derived("qacc")[:, self._dof_index]

    @property
    def applied_effort(self) -> Tensor:
        """Forces of the actuators on the joints, after their limits. (num_envs, k) [N or N m]"""
        return self._sim.derived("qfrc_actuator")[:, self._dof_index]

    @property
    def root_pos_w(self) -> Tensor:
        """Root position. (num_envs, 3) [m]"""
        q = self._entity.root_qpos
        if self._entity.mocap >= 0:
            return self._sim.derived("mocap_pos")[:, self._entity.mocap]
        return self._sim.qpos[:, q : q + 3] if q is not None else self.default_root_state[:, :3]

    @property
    def root_quat_w(self) -> Tensor:
        """Root orientation (w, x, y, z). (num_envs, 4)"""
        q = self._entity.root_qpos
        if self._entity.mocap >= 0:
            return self._sim.derived("mocap_quat")[:, self._entity.mocap]
        return self._sim.qpos[:, q + 3 : q + 7] if q is not None else self.default_root_state[:, 3:7]

    @property
    def root_lin_vel_w(self) -> Tensor:
        """Root linear velocity, world frame. (num_envs, 3) [m/s]"""
        d = self._entity.root_dof
        return self._sim.qvel[:, d : d + 3] if d is not None else self.default_root_state[:, 7:10]

    @property
    def root_ang_vel_b(self) -> Tensor:
        """Root angular velocity, body frame. (num_envs, 3) [rad/s]"""
        d = self._entity.root_dof
        return self._sim.qvel[:, d + 3 : d + 6] if d is not None else self.default_root_state[:, 10:13]

    @property
    def root_lin_vel_b(self) -> Tensor:
        """Root linear velocity, body frame. (num_envs, 3) [m/s]"""
        return self._once("root_lin_vel_b", lambda: rotate_inverse(self.root_quat_w, self.root_lin_vel_w))

    @property
    def root_ang_vel_w(self) -> Tensor:
        """Root angular velocity, world frame. (num_envs, 3) [rad/s]"""
        return self._once("root_ang_vel_w", lambda: rotate(self.root_quat_w, self.root_ang_vel_b))

    @property
    def root_com_lin_vel_w(self) -> Tensor:
        """Velocity of the root body's centre of mass, world frame. (num_envs, 3) [m/s]"""
        return self.body_com_lin_vel_w[:, 0]

    @property
    def forward_w(self) -> Tensor:
        """The root's x axis, world frame. (num_envs, 3)"""
        return self._once("forward_w", lambda: axis_x(self.root_quat_w))

    @property
    def heading_w(self) -> Tensor:
        """Direction of the root's x axis in the horizontal plane, about z from the world's x. (num_envs,) [rad]"""
        return self._once("heading_w", lambda: atan2(self.forward_w[:, 1], self.forward_w[:, 0]))

    @property
    def gravity_w(self) -> Tensor:
        """Gravity, the environment's own where it differs between environments. (num_envs, 3) [m/s^2]"""
        own = self._entity.engine.expanded("opt.gravity")
        return self._gravity if own is None else self._once("gravity_w", lambda: own.float().view(-1, 3))

    @property
    def down_w(self) -> Tensor:
        """Direction of gravity, length 1; -z where there is none. (num_envs, 3)"""
        if self._entity.engine.expanded("opt.gravity") is None:
            return self._down
        return self._once("down_w", lambda: _direction(self.gravity_w))

    @property
    def projected_gravity_b(self) -> Tensor:
        """Direction of gravity in the root's frame, length 1. (num_envs, 3)"""
        return self._once("projected_gravity_b", lambda: rotate_inverse(self.root_quat_w, self.down_w))

    @property
    def computed_effort(self) -> Tensor:
        """What actuators would put on the joints without limits on forces. (num_envs, k) [N or N m]

        Of actuator models, in the last substep. Of MuJoCo's actuators with a fixed gain, no or an affine bias and no
        dynamics of their own (motor, position, velocity), by the present state and controls. Others count as 0.
        """
        return self._once("computed_effort", self._drives.computed)

    @property
    def joint_effort_limits(self) -> Tensor:
        """Largest effort of the actuators on each joint, infinite where nothing limits it. (1 or num_envs, k)

        [N or N m] From force limits of actuators and joints, and control limits of motors.
        """
        return self._once("joint_effort_limits", self._drives.limits)

    @property
    def withheld_effort(self) -> Tensor:
        """How much less than `computed_effort` limits let through, >= 0. (num_envs, k) [N or N m]"""
        return self._once("withheld_effort", self._drives.withheld)

    def joint_limits(self, soft: bool = False) -> tuple[Tensor, Tensor]:
        """Lower and upper position limits as they are now, infinite where there is none. (num_envs or 1, k) each

        `joint_pos_limits` are those of the configuration; these follow a randomisation.
        """
        ranges = self._entity.engine.expanded("jnt_range")
        if ranges is None:
            low, high = self._limits[soft]
            return low, high
        low, high = self._once(
            "joint_ranges", lambda: ranges.view(len(ranges), -1, 2)[:, self._joint_index].float()
        ).unbind(dim=2)
        if soft:
            half = 0.5 * self._entity.config.soft_joint_pos_limit_factor * (high - low)
            middle = 0.5 * (low + high)
            low, high = middle - half, middle + half
        return torch.where(self._limited, low, self._infinite[0]), torch.where(self._limited, high, self._infinite[1])

    @property
    def body_pos_w(self) -> Tensor:
        """Body positions. (num_envs, bodies, 3) [m]"""
        return self._sim.derived("xpos")[:, self._body_index]

    @property
    def body_quat_w(self) -> Tensor:
        """Body orientations (w, x, y, z). (num_envs, bodies, 4)"""
        return self._sim.derived("xquat")[:, self._body_index]

    @property
    def body_com_pos_w(self) -> Tensor:
        """Centres of mass of the bodies. (num_envs, bodies, 3) [m]"""
        return self._sim.derived("xipos")[:, self._body_index]

    @property
    def body_ang_vel_w(self) -> Tensor:
        """Angular velocities of the bodies, world frame. (num_envs, bodies, 3) [rad/s]"""
        return self._sim.derived("cvel")[:, self._body_index, :3]

    @property
    def body_lin_vel_w(self) -> Tensor:
        """Velocities of the bodies' frame origins, world frame. (num_envs, bodies, 3) [m/s]"""
        return self._once("body_lin_vel_w", lambda: self._velocity_at(self.body_pos_w))

    @property
    def body_com_lin_vel_w(self) -> Tensor:
        """Velocities of the bodies' centres of mass, world frame. (num_envs, bodies, 3) [m/s]"""
        return self._once("body_com_lin_vel_w", lambda: self._velocity_at(self.body_com_pos_w))

    @property
    def body_lin_vel_b(self) -> Tensor:
        """Velocities of the bodies' frame origins, each in its body's frame. (num_envs, bodies, 3) [m/s]"""
        return self._once("body_lin_vel_b", lambda: rotate_inverse(self.body_quat_w, self.body_lin_vel_w))

    @property
    def body_ang_vel_b(self) -> Tensor:
        """Angular velocities of the bodies, each in its body's frame. (num_envs, bodies, 3) [rad/s]"""
        return self._once("body_ang_vel_b", lambda: rotate_inverse(self.body_quat_w, self.body_ang_vel_w))

    @property
    def body_ang_acc_w(self) -> Tensor:
        """Angular accelerations over the last substep, world frame. (num_envs, bodies, 3) [rad/s^2]"""
        return self._body_force("cacc")[:, self._body_index, :3]

    @property
    def body_lin_acc_w(self) -> Tensor:
        """Accelerations of the bodies' frame origins over the last substep, world frame. (num_envs, bodies, 3) [m/s^2]

        0 at rest, and that of gravity in free fall.
        """

        def compute() -> Tensor:
            acceleration = self._body_force("cacc")[:, self._body_index]
            angular, linear = acceleration[..., :3], acceleration[..., 3:]
            at_origin = linear + torch.linalg.cross(angular, self._from_tree_com(self.body_pos_w))
            turning = torch.linalg.cross(self.body_ang_vel_w, self.body_lin_vel_w)
            return at_origin + turning + self.gravity_w[:, None]  # MuJoCo's accelerations are against gravity

        return self._once("body_lin_acc_w", compute)

    @property
    def body_incoming_wrench_b(self) -> Tensor:
        """Force and torque by which each body's parent holds it, in the body's frame. (num_envs, bodies, 6) [N, N m]

        Of the last substep; the torque is about the body's frame origin.
        """

        def compute() -> Tensor:
            wrench = self._body_force("cfrc_int")[:, self._body_index]
            force = wrench[..., 3:]
            torque = wrench[..., :3] - torch.linalg.cross(self._from_tree_com(self.body_pos_w), force)
            quat = self.body_quat_w
            return torch.cat([rotate_inverse(quat, force), rotate_inverse(quat, torque)], dim=-1)

        return self._once("body_incoming_wrench_b", compute)

    @property
    def site_pos_w(self) -> Tensor:
        """Site positions. (num_envs, sites, 3) [m]"""
        return self._sim.derived("site_xpos")[:, self._site_index]

    @property
    def site_quat_w(self) -> Tensor:
        """Site orientations (w, x, y, z). (num_envs, sites, 4)"""
        return self._once(
            "site_quat_w",
            lambda: multiply(self._sim.derived("xquat")[:, self._site_body], self._site_quat),
        )

    @property
    def site_ang_vel_w(self) -> Tensor:
        """Angular velocities of the sites, world frame. (num_envs, sites, 3) [rad/s]"""
        return self._sim.derived("cvel")[:, self._site_body, :3]

    @property
    def site_lin_vel_w(self) -> Tensor:
        """Velocities of the sites, world frame. (num_envs, sites, 3) [m/s]"""

        def compute() -> Tensor:
            roots = self._tree_root_of_sites
            arm = self.site_pos_w - self._sim.derived("subtree_com")[:, roots]
            velocity = self._sim.derived("cvel")[:, self._site_body]
            return velocity[..., 3:] + torch.linalg.cross(velocity[..., :3], arm)

        return self._once("site_lin_vel_w", compute)

    @property
    def sensordata(self) -> Tensor:
        """All sensor readings of the model, in the units of each sensor. (num_envs, nsensordata)"""
        return self._sim.derived("sensordata")

    def _velocity_at(self, points: Tensor) -> Tensor:
        """Velocity of a point of each body: MuJoCo gives that at the centre of mass of the body's tree."""
        velocity = self._sim.derived("cvel")[:, self._body_index]
        return velocity[..., 3:] + torch.linalg.cross(velocity[..., :3], self._from_tree_com(points))

    def _from_tree_com(self, points: Tensor) -> Tensor:
        return points - self._sim.derived("subtree_com")[:, self._tree_root]

    def _body_force(self, name: str) -> Tensor:
        if not self._computes_body_forces:
            raise ValueError(
                "reads accelerations or forces of bodies, which MuJoCo computes only where a sensor needs them: mark"
                " the term with rlcli.task.reads_body_forces, or give the MJCF an accelerometer, force or torque sensor"
            )
        return self._sim.derived(name)

    def _once(self, name: Hashable, compute: Callable[[], Tensor]) -> Tensor:
        stamp, value = self._cache.get(name, (-1, None))
        if stamp != self._sim.stamp or value is None:
            value = compute()
            self._cache[name] = (self._sim.stamp, value)
        return value

    def _default_root(self, model: mujoco.MjModel) -> Tensor:
        entity = self._entity
        if entity.root_qpos is not None:
            pose = model.qpos0[entity.root_qpos : entity.root_qpos + 7]
        elif not entity.root_body:  # geoms of the world only
            pose = np.concatenate([entity.config.pos, entity.config.quat])
        else:
            body = entity.root_body
            pose = np.concatenate([model.body_pos[body], model.body_quat[body]])
        velocity = [*entity.config.init.lin_vel, *entity.config.init.ang_vel]
        if entity.root_qpos is None and any(velocity):
            raise NameProblem(
                f"entity '{entity.name}' has no free root", "lin_vel and ang_vel are those of a free root"
            )
        return torch.tensor([*pose, *velocity], dtype=torch.float32)


class _Parts:
    """`values[:, joints]` of what is read in every step: of the same tensor and the same slice, the same view."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Columns, Tensor, Tensor]] = {}

    def of(self, values: Tensor, joints: Columns) -> Tensor:
        """`values[:, joints]`."""
        known = self._known.get(id(joints))
        if known is not None and known[0] is joints and known[1] is values:
            return known[2]
        part = values[:, joints]
        if isinstance(joints, slice):  # what another index gives is a copy
            if len(self._known) >= _MOST_PARTS:
                self._known.clear()
            # the index stays referenced, so that its id is not given to another
            self._known[id(joints)] = joints, values, part
        return part


class _Drives:
    """The actuators on an entity's joints whose force is gain x control + an affine function of the joint's state."""

    def __init__(self, entity: Entity) -> None:
        self._entity = entity
        model, device = entity.engine.model, entity.engine.device
        columns = {int(joint): column for column, joint in enumerate(entity.joint_ids)}
        ids = [
            a
            for a in range(model.nu)
            if int(model.actuator_trnid[a, 0]) in columns
            and model.actuator_gear[a, 0]
            and model.actuator_trntype[a] == int(mujoco.mjtTrn.mjTRN_JOINT)
            and model.actuator_dyntype[a] == int(mujoco.mjtDyn.mjDYN_NONE)
            and model.actuator_gaintype[a] == int(mujoco.mjtGain.mjGAIN_FIXED)
            and model.actuator_biastype[a] in (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
        ]
        self._ids = torch.tensor(ids, dtype=torch.int64, device=device)
        self._columns = torch.tensor([columns[int(model.actuator_trnid[a, 0])] for a in ids], device=device).long()
        self._gear = torch.tensor(model.actuator_gear[ids, 0], dtype=torch.float32, device=device)
        self._is_motor = torch.tensor(model.actuator_biastype[ids] == int(mujoco.mjtBias.mjBIAS_NONE), device=device)
        self._constant = {
            name: torch.tensor(getattr(model, name)[ids][None], dtype=torch.float32, device=device)
            for name in ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "actuator_ctrlrange")
        }
        self._force_limited, self._control_limited = (
            torch.tensor(values[ids], dtype=torch.bool, device=device)
            for values in (model.actuator_forcelimited, model.actuator_ctrllimited)
        )
        self._joint_limits = torch.full((len(columns),), math.inf, device=device)
        limited = np.flatnonzero(model.jnt_actfrclimited[entity.joint_ids])
        for column in limited:
            high = np.abs(model.jnt_actfrcrange[entity.joint_ids[column]]).max()
            self._joint_limits[int(column)] = float(high)
        self._driven = torch.zeros(len(columns), dtype=torch.bool, device=device)
        self._driven[self._columns] = True
        self._no_range = torch.tensor([-math.inf, math.inf], device=device)
        self._clamped = (self._control_limited & ~self._is_motor)[:, None]
        self._columns_of_models: list[tuple[ActuatorModel, Columns]] = []

    def computed(self) -> Tensor:
        """Efforts before limits. (num_envs, k)"""
        entity = self._entity
        gear, q, v = self._gear, entity.data.joint_pos[:, self._columns], entity.data.joint_vel[:, self._columns]
        gain, bias = self._now("actuator_gainprm"), self._now("actuator_biasprm")
        low, high = torch.where(self._clamped, self._now("actuator_ctrlrange"), self._no_range).unbind(-1)
        control = entity.engine.field("ctrl")[:, self._ids].float().clamp(low, high)
        affine = torch.where(self._is_motor, 0.0, bias[..., 0] + bias[..., 1] * gear * q + bias[..., 2] * gear * v)
        efforts = self._by_joint(gear * (gain[..., 0] * control + affine))
        for model, columns in self._models():
            efforts[:, columns] = model.computed_effort
        return efforts

    def withheld(self) -> Tensor:
        """What limits take away. (num_envs, k)"""
        data = self._entity.data
        beyond = (data.computed_effort.abs() - data.joint_effort_limits).clamp_(min=0.0)
        for model, columns in self._models():
            beyond[:, columns] = (model.computed_effort - model.applied_effort).abs_()
        return beyond

    def limits(self) -> Tensor:
        """Largest efforts. (1 or num_envs, k)"""
        gain, force = self._now("actuator_gainprm")[..., 0], self._now("actuator_forcerange")
        largest = torch.where(self._force_limited, force.abs().amax(dim=-1), math.inf)
        control = (gain[..., None] * self._now("actuator_ctrlrange")).abs().amax(dim=-1)
        largest = torch.where(self._control_limited & self._is_motor, torch.minimum(largest, control), largest)
        limits = torch.minimum(
            torch.where(self._driven, self._by_joint(self._gear.abs() * largest), math.inf), self._joint_limits
        )
        if self._entity.actuators:
            limits = limits.expand(self._entity.engine.num_envs, -1).clone()
        for model, columns in self._models():
            limits[:, columns] = model.effort_limit
        return limits

    def _models(self) -> list[tuple[ActuatorModel, Columns]]:
        """The entity's actuator models, which are made after it, with the joints that they drive."""
        if len(self._columns_of_models) != len(self._entity.actuators):
            device = self._entity.engine.device
            self._columns_of_models = [(m, as_index(m.joints, device)) for m in self._entity.actuators]
        return self._columns_of_models

    def _by_joint(self, values: Tensor) -> Tensor:
        total = torch.zeros(len(values), len(self._joint_limits), device=values.device)
        return total.index_add_(1, self._columns, values)

    def _now(self, name: str) -> Tensor:
        own = self._entity.engine.expanded(name)
        return self._constant[name] if own is None else own[:, self._ids].float()


def _direction(gravity: Tensor) -> Tensor:
    """Where gravity points, length 1; -z where there is none. (n, 3)"""
    size = length(gravity)[:, None]
    down = torch.zeros_like(gravity)
    down[:, 2].fill_(-1.0)
    return torch.where(size > 0.0, gravity / size, down)


def default_joint_state(entity: Entity) -> tuple[Tensor, Tensor]:
    """Default joint positions and velocities: the MJCF's qpos0, with the entity's `init` over it. (k,), (k,)

    Raises:
        NameProblem: if `init` names a joint that the model does not have.
    """
    position = torch.tensor(entity.engine.model.qpos0[entity.qpos_columns.cpu().numpy()], dtype=torch.float32)
    velocity = torch.zeros_like(position)
    for values, target in (
        (entity.config.init.joint_pos, position),
        (entity.config.init.joint_vel, velocity),
    ):
        for pattern, value in values.items():
            target[match(pattern, entity.joint_names, "joint")] = value
    return position, velocity


def as_index(positions: Sequence[int], device: torch.device | None = None) -> Columns:
    """Column positions as a slice where they are consecutive (a view, not a copy), else as a tensor."""
    first = positions[0] if len(positions) else 0
    if list(positions) == list(range(first, first + len(positions))):
        return _consecutive(first, first + len(positions))
    return torch.tensor(list(positions), dtype=torch.int64, device=device)


@functools.lru_cache(maxsize=4096)
def _consecutive(first: int, stop: int) -> slice:
    """One object for all who ask, so that what they read of it is made once for all."""
    return slice(first, stop)


def is_finite(values: Tensor) -> bool:
    """Whether every value is finite, in one pass where they are: a finite sum has finite summands only."""
    return math.isfinite(values.sum().item()) or bool(values.isfinite().all())


def _joined(left: Tensor, right: Tensor) -> Tensor | None:
    """Two 2-d views as one, where they are neighbouring columns of the same storage; else None."""
    neighbours = (
        left.dtype == right.dtype
        and left.stride() == right.stride()
        and left.untyped_storage().data_ptr() == right.untyped_storage().data_ptr()
        and right.data_ptr() == left.data_ptr() + left.shape[1] * left.element_size()
    )
    if not neighbours:
        return None
    return left.as_strided((left.shape[0], left.shape[1] + right.shape[1]), left.stride())


def _ids(
    model: mujoco.MjModel,
    entity: str,
    kind: mujoco.mjtObj,
    count: int,
    keep: Callable[[int], bool] = lambda _: True,
) -> np.ndarray:
    prefix = f"{entity}/"
    ids = [i for i in range(count) if (mujoco.mj_id2name(model, kind, i) or "").startswith(prefix) and keep(i)]
    return np.array(ids, dtype=np.int64)


def _names(model: mujoco.MjModel, entity: str, kind: mujoco.mjtObj, ids: np.ndarray) -> list[str]:
    return [(mujoco.mj_id2name(model, kind, int(i)) or "").removeprefix(f"{entity}/") for i in ids]

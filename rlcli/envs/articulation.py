"""Class `ArticulationView`: the robots of all environments as tensors, with the method names of OmniIsaacGymEnvs.

Direct tasks that were written for OmniIsaacGymEnvs read and set joint states with this class.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.errors import TaskError, did_you_mean, listing
from rlcli.scene.entity import Entity
from rlcli.sim.column_views import as_index
from rlcli.sim.env_selection import Columns, write_rows
from rlcli.sim.rotations import rotate_inverse


class ArticulationView:
    """View of one entity (a robot or an object) in all environments, with getters and setters of tensors.

    A direct task registers the view with `scene.add` and can use it from `post_reset` on. Columns are the hinge and
    slide joints of the entity, in the order of the model. The argument `indices` (n,) selects environments; values then
    have one row for each index, else one row for each environment. Positions are in the world frame of each
    environment's own simulation. Unlike in OmniIsaacGymEnvs, setters may be called several times in a step, and getters
    return current values.

    Args:
        entity: name of the entity in the YAML's scene.
        name: name of the view in messages and dictionaries of observations; None: `entity`.
    """

    def __init__(self, entity: str, name: str | None = None) -> None:
        self.entity_name = entity
        self.name = name or entity

    def bind(self, env: VecEnv) -> None:
        """Connect the view to the simulation. The environment calls this method when it is built.

        Raises:
            TaskError: if the scene has no such entity.
        """
        if self.entity_name not in env.entities:
            near = did_you_mean(self.entity_name, env.entities) or f"entities: {listing(env.entities)}"
            raise TaskError(f"ArticulationView('{self.entity_name}'): no such entity in the scene", hint=near)
        self._env = env
        self._entity: Entity = env.entities[self.entity_name]
        engine = env.engine
        self._qpos, self._ctrl = engine.field("qpos"), engine.field("ctrl")
        self._qpos_index = as_index(self._entity.qpos_columns.tolist(), engine.device)
        self._dof_index = as_index(self._entity.dof_columns.tolist(), engine.device)
        has_motor = {joint for joint, _ in self._entity.actuators_of("motor")}
        self._without_motor = [j for j in range(len(self._entity.joint_names)) if j not in has_motor]
        self._actuators = {kind: _make_drive(self._entity, kind) for kind in ("motor", "position", "velocity")}

    @property
    def count(self) -> int:
        """Number of robots, one for each environment."""
        return self._env.num_envs

    @property
    def num_dof(self) -> int:
        """Number of hinge and slide joints."""
        return len(self._entity.joint_names)

    @property
    def dof_names(self) -> list[str]:
        """Joint names, in the order of the columns."""
        return list(self._entity.joint_names)

    def get_dof_index(self, name: str) -> int:
        """Return the column of a joint.

        Raises:
            TaskError: if there is no such joint.
        """
        if name not in self._entity.joint_names:
            near = did_you_mean(name, self._entity.joint_names) or f"joints: {listing(self._entity.joint_names)}"
            raise TaskError(f"view '{self.name}' has no joint '{name}'", hint=near)
        return self._entity.joint_names.index(name)

    def get_joint_positions(self, indices: Tensor | None = None, clone: bool = True) -> Tensor:
        """Return joint positions. (n, num_dof) [m or rad]

        Without `clone` and `indices` the tensor is a view of the simulation's state: do not write to it.
        """
        return _rows(self._entity.data.joint_pos, indices, clone)

    def get_joint_velocities(self, indices: Tensor | None = None, clone: bool = True) -> Tensor:
        """Return joint velocities. (n, num_dof) [m/s or rad/s]

        Without `clone` and `indices` the tensor is a view of the simulation's state: do not write to it.
        """
        return _rows(self._entity.data.joint_vel, indices, clone)

    def get_dof_limits(self) -> Tensor:
        """Return lower and upper limits, infinite for a joint without limits. (num_envs, num_dof, 2) [m or rad]"""
        return self._entity.data.joint_pos_limits.expand(self.count, -1, -1)

    def get_world_poses(self, indices: Tensor | None = None, clone: bool = True) -> tuple[Tensor, Tensor]:
        """Return root positions [m] and orientations (w, x, y, z), world frame. (n, 3), (n, 4)"""
        data = self._entity.data
        return _rows(data.root_pos_w, indices, clone), _rows(data.root_quat_w, indices, clone)

    def get_velocities(self, indices: Tensor | None = None, clone: bool = True) -> Tensor:
        """Return velocities of the root's origin, world frame: linear [m/s], then angular [rad/s]. (n, 6)"""
        data = self._entity.data
        return _rows(torch.cat([data.root_origin_lin_vel_w, data.root_ang_vel_w], dim=1), indices, clone)

    def set_joint_positions(self, positions: Tensor, indices: Tensor | None = None) -> None:
        """Set joint positions, and position actuators' targets to the same values. (n, num_dof) [m or rad]"""
        self._write_state("qpos", positions, indices, self._qpos_index)
        self._write_controls("position", positions, indices)

    def set_joint_velocities(self, velocities: Tensor, indices: Tensor | None = None) -> None:
        """Set joint velocities, and velocity actuators' targets to the same values. (n, num_dof) [m/s or rad/s]"""
        self._write_state("qvel", velocities, indices, self._dof_index)
        self._write_controls("velocity", velocities, indices)

    def set_joint_efforts(self, efforts: Tensor, indices: Tensor | None = None) -> None:
        """Set the efforts of the joint motors; they last until the next call. (n, num_dof) [N or N m]

        Each motor's limit still applies.

        Raises:
            TaskError: for an effort other than 0 on a joint without a motor.
        """
        if self._without_motor and bool(efforts[:, self._without_motor].any()):
            names = listing(self._entity.joint_names[j] for j in self._without_motor)
            hint = "give these joints `actuator: motor` in scene.entities, or set targets of their actuators"
            raise TaskError(f"view '{self.name}': no motor drives {names}, so efforts cannot act", hint=hint)
        self._write_controls("motor", efforts, indices)

    def set_joint_position_targets(self, positions: Tensor, indices: Tensor | None = None) -> None:
        """Set the targets of position actuators. (n, num_dof) [m or rad]"""
        self._write_controls("position", positions, indices)

    def set_joint_velocity_targets(self, velocities: Tensor, indices: Tensor | None = None) -> None:
        """Set the targets of velocity actuators. (n, num_dof) [m/s or rad/s]"""
        self._write_controls("velocity", velocities, indices)

    def set_world_poses(self, positions: Tensor, orientations: Tensor, indices: Tensor | None = None) -> None:
        """Set root poses of a floating robot, world frame. (n, 3) [m], (n, 4) w, x, y, z"""
        root, _ = self._entity.floating()
        self._write_state("qpos", torch.cat([positions, orientations], dim=1), indices, slice(root, root + 7))

    def set_velocities(self, velocities: Tensor, indices: Tensor | None = None) -> None:
        """Set velocities of the root's origin of a floating robot, world frame. (n, 6) [m/s, rad/s]"""
        qpos, dof = self._entity.floating()
        rows = slice(None) if indices is None else indices.long()
        quat = self._qpos[rows][:, qpos + 3 : qpos + 7].float()
        # MuJoCo: the angular velocity of a free joint is in the body frame
        local = torch.cat([velocities[:, :3], rotate_inverse(quat, velocities[:, 3:])], dim=1)
        self._write_state("qvel", local, indices, slice(dof, dof + 6))

    def _write_controls(self, kind: str, values: Tensor, indices: Tensor | None) -> None:
        drive = self._actuators[kind]
        if drive is not None:
            self._write(self._ctrl, drive.controls_for(values), indices, drive.controls)

    def _write_state(self, name: str, values: Tensor, indices: Tensor | None, columns: Columns) -> None:
        self._write(self._env.engine.field(name), values, indices, columns)
        # the getters read `env.sim`, a copy of the engine's state
        self._write(getattr(self._env.sim, name), values, indices, columns)
        self._env.sim.stamp += 1  # invalidates cached values that were computed from the old state

    def _write(self, field: Tensor, values: Tensor, indices: Tensor | None, columns: Columns) -> None:
        if indices is not None and field.device.type == "cpu":
            write_rows(field, indices.long().numpy(), values, columns)
            return
        rows = slice(None) if indices is None else indices.long()
        if not isinstance(columns, slice) and isinstance(rows, Tensor):
            rows = rows[:, None]  # indices (n, 1) and (k,) select n x k values
        field[rows, columns] = values.to(field.dtype)


def _rows(values: Tensor, indices: Tensor | None, clone: bool) -> Tensor:
    if indices is not None:
        return values[indices.long()]
    return values.clone() if clone else values


@dataclass(frozen=True, slots=True)
class _Drive:
    """Actuators of one kind (motor, position or velocity) of an entity, and the joints that they drive."""

    joints: Columns | None
    """Columns of the driven joints; None: all joints, in order."""
    controls: Columns
    """Columns of the actuators in MuJoCo's `ctrl`."""
    factor: Tensor | None
    """Factor from the effort or target of a joint to the control. (k,); None: 1."""

    def controls_for(self, values: Tensor) -> Tensor:
        """Return the `ctrl` of the k actuators for efforts or targets of all joints. (n, num_dof) -> (n, k)"""
        driven = values if self.joints is None else values[:, self.joints]
        return driven if self.factor is None else driven * self.factor


def _make_drive(entity: Entity, kind: str) -> _Drive | None:
    """Return an entity's actuators of a kind (motor, position, velocity); None if it has no actuator of this kind.

    A gear multiplies forces and lengths: a joint's force is divided by the gear, a joint's target is multiplied by it.
    """
    columns = entity.actuators_of(kind)
    if not columns:
        return None
    device, joints, controls = entity.engine.device, [joint for joint, _ in columns], [a for _, a in columns]
    gear = entity.engine.model.actuator_gear[controls, 0]
    factor = torch.tensor(1.0 / gear if kind == "motor" else gear, dtype=torch.float32, device=device)
    return _Drive(
        None if joints == list(range(len(entity.joint_names))) else as_index(joints, device),
        as_index(controls, device),
        None if bool((factor == 1.0).all()) else factor,
    )

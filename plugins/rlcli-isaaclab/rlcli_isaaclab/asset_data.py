"""State of a robot or object (asset) as Isaac Lab's terms read it: `asset.data.joint_pos`."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.errors import did_you_mean, listing
from rlcli.scene.entity import Entity
from rlcli.scene.entity_data import EntityData
from rlcli.sim.env_selection import ALL
from rlcli.sim.rotations import conjugate, multiply, rotate, rotate_inverse
from rlcli_isaaclab.missing_names import user_place
from rlcli_isaaclab.substeps import update_state
from rlcli_isaaclab.utils.math import quat_from_matrix

_DATA_NAMES = {
    "applied_torque": "applied_effort",
    "root_link_heading_w": "heading_w",
    "computed_torque": "computed_effort",
    "root_link_pos_w": "root_pos_w",
    "root_link_quat_w": "root_quat_w",
    "root_link_lin_vel_w": "root_origin_lin_vel_w",
    "root_link_ang_vel_w": "root_ang_vel_w",
    "root_link_ang_vel_b": "root_ang_vel_b",
    "root_com_ang_vel_w": "root_ang_vel_w",
    "root_com_ang_vel_b": "root_ang_vel_b",
    "root_lin_vel_w": "root_com_lin_vel_w",
    "body_link_pos_w": "body_pos_w",
    "body_link_quat_w": "body_quat_w",
    "body_link_ang_vel_w": "body_ang_vel_w",
    "body_com_ang_vel_w": "body_ang_vel_w",
    "body_com_lin_acc_w": "body_lin_acc_w",
    "body_com_ang_acc_w": "body_ang_acc_w",
    "body_incoming_joint_wrench_b": "body_incoming_wrench_b",
}
"""Isaac Lab's name -> rlcli's name, where they differ. In Isaac Lab, a velocity without `link` in its name is that of
the centre of mass; the entity's `velocity_point` does not change this."""


_MOST_VELOCITY = math.radians(1e6)
"""Speed limit of a joint without a limit in Isaac Sim [rad/s]. It is finite, because terms multiply it by 0."""


class Data:
    """State of an asset under Isaac Lab's names. The names of `rlcli.scene.entity_data.EntityData` work too."""

    def __init__(self, env: VecEnv, entity: Entity) -> None:
        self._env, self._entity = env, entity
        self.joint_names, self.body_names = list(entity.joint_names), list(entity.names["Bodies"])
        self.default_joint_stiffness, self.default_joint_damping = self._gains(1), self._gains(2)
        """Gains before any event. (num_envs, joints) each [N/m or N m/rad, N s/m or N m s/rad]"""

    @property
    def _data(self) -> EntityData:
        """State of the entity. It is computed again if a physics step has run since the last time."""
        update_state(self._env)
        return self._entity.data

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        try:
            return getattr(self._data, _DATA_NAMES.get(name, name))
        except AttributeError:
            known = [n for n in (*dir(type(self)), *dir(self._data), *_DATA_NAMES) if not n.startswith("_")]
            hint = did_you_mean(name, known) or f"its attributes: {listing(known, 60)}"
            raise AttributeError(f"{user_place()}asset.data has no '{name}'; {hint}") from None

    @property
    def joint_stiffness(self) -> Tensor:
        """Stiffness of the joints, after events. (num_envs, joints) [N/m or N m/rad]"""
        return self._gains(1)

    @property
    def joint_damping(self) -> Tensor:
        """Damping of the joints, after events. (num_envs, joints) [N s/m or N m s/rad]"""
        return self._gains(2)

    def _gains(self, column: int) -> Tensor:
        """Return stiffness (column 1) or damping (column 2) of the joints, from the model and the actuator models."""
        engine, entity = self._env.engine, self._entity
        found = torch.zeros(self._env.num_envs, len(self.joint_names), device=self._env.device)
        if column == 2:
            found += engine.expand("dof_damping")[:, entity.dof_columns].float()
        for joint, actuator in (*entity.actuators_of("position"), *entity.actuators_of("velocity")):
            found[:, joint] -= engine.expand("actuator_biasprm")[:, actuator, column].float()
        for actuators in entity.actuators:
            found[:, actuators.joints] = actuators.stiffness if column == 1 else actuators.damping
        return found

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

    soft_joint_vel_limits = joint_velocity_limits = joint_vel_limits
    joint_limits = default_joint_limits = default_joint_pos_limits = joint_pos_limits

    @property
    def joint_pos_target(self) -> Tensor:
        """Position targets; the default position of joints without one. (num_envs, joints) [m or rad]"""
        return self._targets("position", self._data.default_joint_pos)

    @property
    def joint_vel_target(self) -> Tensor:
        """Velocity targets; 0 for joints without one. (num_envs, joints) [m/s or rad/s]"""
        return self._targets("velocity", torch.zeros_like(self._data.default_joint_pos))

    @property
    def joint_effort_target(self) -> Tensor:
        """Effort targets; 0 for joints without one. (num_envs, joints) [N or N m]"""
        return self._targets("motor", torch.zeros_like(self._data.default_joint_pos))

    def _targets(self, kind: str, start: Tensor) -> Tensor:
        """Return the last commands of one kind to the joints; `start` for joints without such an actuator."""
        found = start.clone()
        gear = self._env.engine.model.actuator_gear[:, 0]
        for joint, actuator in self._entity.actuators_of(kind):
            control = self._env.engine.field("ctrl")[:, actuator].float()
            found[:, joint] = control * float(gear[actuator] if kind == "motor" else 1.0 / gear[actuator])
        for model in self._entity.actuators:
            found[:, model.joints] = model.targets[:, ("position", "velocity", "motor").index(kind)]
        return found

    @property
    def default_mass(self) -> Tensor:
        """Masses of the bodies in the model. (num_envs, bodies) [kg]"""
        masses = self._env.engine.model.body_mass[self._entity.body_ids]
        return torch.as_tensor(masses, dtype=torch.float32).expand(self._env.num_envs, -1).clone()

    @property
    def joint_armature(self) -> Tensor:
        """Armature of the joints. (num_envs, joints) [kg or kg m^2]"""
        return self._env.engine.expand("dof_armature")[:, self._entity.dof_columns].float()

    @property
    def default_inertia(self) -> Tensor:
        """Moments of inertia in the model, as matrices row by row. (num_envs, bodies, 9) [kg m^2]"""
        moments = torch.as_tensor(self._env.engine.model.body_inertia[self._entity.body_ids], dtype=torch.float32)
        return torch.diag_embed(moments).flatten(1).expand(self._env.num_envs, -1, -1).clone()

    @property
    def body_com_quat_w(self) -> Tensor:
        """Principal axes of the bodies' inertia (w, x, y, z), world frame. (num_envs, bodies, 4)"""
        update_state(self._env)
        axes = self._env.sim.derived_field("ximat")[:, self._entity.body_ids]
        return quat_from_matrix(axes.reshape(*axes.shape[:2], 3, 3))

    @property
    def body_com_pose_w(self) -> Tensor:
        """Centres of mass [m] and principal axes (w, x, y, z), world frame. (num_envs, bodies, 7)"""
        return torch.cat([self._data.body_com_pos_w, self.body_com_quat_w], dim=-1)

    @property
    def body_com_pos_b(self) -> Tensor:
        """Centres of mass in the frames of the bodies. (num_envs, bodies, 3) [m]"""
        return rotate_inverse(self._data.body_quat_w, self._data.body_com_pos_w - self._data.body_pos_w)

    @property
    def body_com_quat_b(self) -> Tensor:
        """Principal axes (w, x, y, z) in the frames of the bodies. (num_envs, bodies, 4)"""
        return multiply(conjugate(self._data.body_quat_w), self.body_com_quat_w)

    com_pos_b, com_quat_b = body_com_pos_b, body_com_quat_b

    @property
    def body_com_pose_b(self) -> Tensor:
        """Centres of mass [m] and principal axes in the frames of the bodies. (num_envs, bodies, 7)"""
        return torch.cat([self.body_com_pos_b, self.body_com_quat_b], dim=-1)

    @property
    def body_com_state_w(self) -> Tensor:
        """Centres of mass, principal axes, and velocities of the centres, world frame. (num_envs, bodies, 13)"""
        return torch.cat([self.body_com_pose_w, self.body_vel_w], dim=-1)

    @property
    def body_acc_w(self) -> Tensor:
        """Linear accelerations of the centres of mass, and angular accelerations, world frame. (num_envs, bodies, 6)"""
        return torch.cat([self._data.body_lin_acc_w, self._data.body_ang_acc_w], dim=-1)

    body_com_acc_w = body_acc_w

    @property
    def root_com_pos_w(self) -> Tensor:
        """Centre of mass of the root, world frame. (num_envs, 3) [m]"""
        return self._data.body_com_pos_w[:, 0]

    @property
    def root_com_quat_w(self) -> Tensor:
        """Principal axes of the root's inertia (w, x, y, z), world frame. (num_envs, 4)"""
        return self.body_com_quat_w[:, 0]

    @property
    def root_com_pose_w(self) -> Tensor:
        """Centre of mass of the root [m] and its principal axes, world frame. (num_envs, 7)"""
        return self.body_com_pose_w[:, 0]

    @property
    def root_com_state_w(self) -> Tensor:
        """Pose and velocity of the root's centre of mass, world frame. (num_envs, 13)

        Columns: position [m], quaternion of the root's principal axes (w, x, y, z), linear [m/s] and angular velocity
        [rad/s].
        """
        return self.body_com_state_w[:, 0]

    @property
    def soft_joint_pos_limits(self) -> Tensor:
        """Lower and upper soft limits. (num_envs, joints, 2) [m or rad]"""
        return self._expand_to_envs(self._data.soft_joint_pos_limits)

    @property
    def root_pose_w(self) -> Tensor:
        """Root position [m] and quaternion (w, x, y, z), world frame. (num_envs, 7)"""
        return torch.cat([self._data.root_pos_w, self._data.root_quat_w], dim=1)

    @property
    def root_lin_vel_b(self) -> Tensor:
        """Velocity of the root's centre of mass, root frame. (num_envs, 3) [m/s]"""
        return rotate_inverse(self._data.root_quat_w, self._data.root_com_lin_vel_w)

    root_com_lin_vel_b = root_lin_vel_b

    @property
    def root_link_lin_vel_b(self) -> Tensor:
        """Velocity of the root's origin, root frame. (num_envs, 3) [m/s]"""
        return rotate_inverse(self._data.root_quat_w, self._data.root_origin_lin_vel_w)

    @property
    def root_vel_w(self) -> Tensor:
        """Velocity of the root's centre of mass [m/s] and angular velocity [rad/s], world frame. (num_envs, 6)"""
        return torch.cat([self._data.root_com_lin_vel_w, self._data.root_ang_vel_w], dim=1)

    root_com_vel_w = root_vel_w

    @property
    def root_link_vel_w(self) -> Tensor:
        """Velocity of the root's origin [m/s] and angular velocity [rad/s], world frame. (num_envs, 6)"""
        return torch.cat([self._data.root_origin_lin_vel_w, self._data.root_ang_vel_w], dim=1)

    @property
    def root_state_w(self) -> Tensor:
        """Root pose, and velocity of its centre of mass, world frame. (num_envs, 13)"""
        return torch.cat([self.root_pose_w, self.root_vel_w], dim=1)

    @property
    def root_link_state_w(self) -> Tensor:
        """Root pose, and velocity of its origin, world frame. (num_envs, 13)"""
        return torch.cat([self.root_pose_w, self.root_link_vel_w], dim=1)

    root_link_pose_w = root_pose_w

    @property
    def body_lin_vel_w(self) -> Tensor:
        """Velocities of the bodies' centres of mass, world frame. (num_envs, bodies, 3) [m/s]"""
        return self._data.body_lin_vel_of(ALL, "com")

    body_com_lin_vel_w = body_lin_vel_w

    @property
    def body_link_lin_vel_w(self) -> Tensor:
        """Velocities of the bodies' origins, world frame. (num_envs, bodies, 3) [m/s]"""
        return self._data.body_lin_vel_of(ALL, "origin")

    @property
    def body_pose_w(self) -> Tensor:
        """Positions [m] and quaternions (w, x, y, z) of all bodies, world frame. (num_envs, bodies, 7)"""
        return torch.cat([self._data.body_pos_w, self._data.body_quat_w], dim=-1)

    body_link_pose_w = body_pose_w

    @property
    def body_vel_w(self) -> Tensor:
        """Linear velocities of the centres of mass and angular velocities, world frame. (num_envs, bodies, 6)"""
        return torch.cat([self.body_lin_vel_w, self._data.body_ang_vel_w], dim=-1)

    body_com_vel_w = body_vel_w

    @property
    def body_link_vel_w(self) -> Tensor:
        """Linear velocities of the origins and angular velocities, world frame. (num_envs, bodies, 6)"""
        return torch.cat([self.body_link_lin_vel_w, self._data.body_ang_vel_w], dim=-1)

    @property
    def body_state_w(self) -> Tensor:
        """Poses of all bodies, and velocities of their centres of mass, world frame. (num_envs, bodies, 13)"""
        return torch.cat([self.body_pose_w, self.body_vel_w], dim=-1)

    @property
    def body_link_state_w(self) -> Tensor:
        """Poses of all bodies, and velocities of their origins, world frame. (num_envs, bodies, 13)"""
        return torch.cat([self.body_pose_w, self.body_link_vel_w], dim=-1)

    @property
    def GRAVITY_VEC_W(self) -> Tensor:  # noqa: N802
        """Unit vector along gravity, world frame. (num_envs, 3)"""
        return self._data._down

    @property
    def FORWARD_VEC_B(self) -> Tensor:  # noqa: N802
        """Unit vector along the x axis, root frame. (num_envs, 3)"""
        return torch.eye(3, device=self._env.device)[:1].expand(self._env.num_envs, 3)

    @property
    def heading_w(self) -> Tensor:
        """Angle of the root's x axis around z, world frame [rad]. (num_envs,)"""
        forward = rotate(self._data.root_quat_w, self.FORWARD_VEC_B)
        return torch.atan2(forward[:, 1], forward[:, 0])

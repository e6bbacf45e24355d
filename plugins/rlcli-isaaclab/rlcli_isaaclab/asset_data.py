"""States of an asset as Isaac Lab's terms read them: `asset.data.joint_pos`."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.errors import did_you_mean, listing
from rlcli.scene.entity import Entity
from rlcli.scene.entity_data import EntityData
from rlcli.sim.rotations import rotate, rotate_inverse
from rlcli.sim.selection import ALL
from rlcli_isaaclab.substeps import update_state

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
}
"""Isaac Lab's name -> rlcli's name, where they differ. Isaac Lab's velocities without `link` are those of the centre of
mass, whatever the entity's `velocity_point` is."""


_MOST_VELOCITY = math.radians(1e6)
"""Speed limit of a joint without a limit in Isaac Sim [rad/s]. It is finite, because terms multiply it by 0."""


class Data:
    """State of an asset under Isaac Lab's names. The names of `rlcli.scene.entity_data.EntityData` work too."""

    def __init__(self, env: VecEnv, entity: Entity) -> None:
        self._env, self._entity = env, entity
        self.joint_names, self.body_names = list(entity.joint_names), list(entity.names["Bodies"])

    @property
    def _data(self) -> EntityData:
        """State of the entity, of the physics step that comes next."""
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
        """Unit vector along the x axis. (num_envs, 3)"""
        return torch.eye(3, device=self._env.device)[:1].expand(self._env.num_envs, 3)

    @property
    def heading_w(self) -> Tensor:
        """Angle of the root's x axis around z, world frame [rad]. (num_envs,)"""
        forward = rotate(self._data.root_quat_w, self.FORWARD_VEC_B)
        return torch.atan2(forward[:, 1], forward[:, 0])

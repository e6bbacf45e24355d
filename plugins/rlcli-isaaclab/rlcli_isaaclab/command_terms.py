"""Command classes with Isaac Lab's interface, for the user's subclasses and for terms that read their attributes.

Where a task has no subclass and its terms do not read such attributes, rlcli's built-in command replaces the class.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rlcli_isaaclab.managers import CommandTerm
from rlcli_isaaclab.utils.math import (
    combine_frame_transforms,
    compute_pose_error,
    quat_apply_inverse,
    quat_from_euler_xyz,
    quat_unique,
    sample_uniform,
    wrap_to_pi,
    yaw_quat,
)


class _RobotCommand(CommandTerm):
    """Base class of commands for one robot."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        self.robot = env.scene[cfg.asset_name]

    def _zeros(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.zeros(self.num_envs, *shape, dtype=dtype, device=self.device)

    def _sample(self, env_ids: Any, ends: Any) -> Tensor:
        return sample_uniform(ends[0], ends[1], (len(env_ids),), self.device)

    def _happens(self, env_ids: Any, probability: float) -> Tensor:
        return self._sample(env_ids, (0.0, 1.0)) <= probability


class UniformVelocityCommand(_RobotCommand):
    """Command of a velocity in the robot's frame, sampled uniformly: x, y [m/s] and yaw rate [rad/s]."""

    elements = ("vx", "vy", "wz")
    units = ("m/s", "m/s", "rad/s")

    @property
    def limits(self) -> list[Any]:
        """Present range of each column; empty if another distribution draws the commands."""
        ranges = self.cfg.ranges
        names = ("lin_vel_x", "lin_vel_y", "ang_vel_z")
        return [getattr(ranges, name) for name in names] if all(hasattr(ranges, name) for name in names) else []

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        if cfg.heading_command and cfg.ranges.heading is None:
            raise ValueError("heading_command is true; set ranges.heading")
        self.vel_command_b, self.heading_target = self._zeros(3), self._zeros()
        self.is_heading_env, self.is_standing_env = self._zeros(dtype=torch.bool), self._zeros(dtype=torch.bool)
        self.metrics.update(error_vel_xy=self._zeros(), error_vel_yaw=self._zeros())

    @property
    def command(self) -> Tensor:
        """Commanded velocities: forwards, to the left [m/s], and yaw rate [rad/s]. (num_envs, 3)"""
        return self.vel_command_b

    def _update_metrics(self) -> None:
        steps = self.cfg.resampling_time_range[1] / self._env.step_dt
        linear = self.vel_command_b[:, :2] - self.robot.data.root_lin_vel_b[:, :2]
        self.metrics["error_vel_xy"] += linear.norm(dim=-1) / steps
        self.metrics["error_vel_yaw"] += (self.vel_command_b[:, 2] - self.robot.data.root_ang_vel_b[:, 2]).abs() / steps

    def _resample_command(self, env_ids: Any) -> None:
        for column, name in enumerate(("lin_vel_x", "lin_vel_y", "ang_vel_z")):
            self.vel_command_b[env_ids, column] = self._sample(env_ids, getattr(self.cfg.ranges, name))
        if self.cfg.heading_command:
            self.heading_target[env_ids] = self._sample(env_ids, self.cfg.ranges.heading)
            self.is_heading_env[env_ids] = self._happens(env_ids, self.cfg.rel_heading_envs)
        self.is_standing_env[env_ids] = self._happens(env_ids, self.cfg.rel_standing_envs)

    def _update_command(self) -> None:
        if self.cfg.heading_command:
            error = wrap_to_pi(self.heading_target - self.robot.data.heading_w)
            turn = (self.cfg.heading_control_stiffness * error).clamp(*self.cfg.ranges.ang_vel_z)
            self.vel_command_b[:, 2] = torch.where(self.is_heading_env, turn, self.vel_command_b[:, 2])
        self.vel_command_b[self.is_standing_env] = 0.0


class NormalVelocityCommand(UniformVelocityCommand):
    """Command of a velocity in the robot's frame, sampled from normal distributions with random signs."""

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        self.is_zero = self._zeros(3, dtype=torch.bool)

    def _resample_command(self, env_ids: Any) -> None:
        ranges = self.cfg.ranges
        for column in range(3):
            normal = torch.randn(len(env_ids), device=self.device) * ranges.std_vel[column] + ranges.mean_vel[column]
            sign = torch.where(self._happens(env_ids, 0.5), 1.0, -1.0)
            self.vel_command_b[env_ids, column] = normal * sign
            self.is_zero[env_ids, column] = self._happens(env_ids, ranges.zero_prob[column])
        self.is_standing_env[env_ids] = self._happens(env_ids, self.cfg.rel_standing_envs)

    def _update_command(self) -> None:
        self.vel_command_b[self.is_standing_env[:, None] | self.is_zero] = 0.0


class UniformPoseCommand(_RobotCommand):
    """Command of a pose of a body, in the frame of the robot's root."""

    elements = ("x", "y", "z", "", "", "", "")
    units = ("m", "m", "m")

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        self.body_idx = self.robot.find_bodies(cfg.body_name)[0][0]
        self.pose_command_b = self._zeros(7)
        self.pose_command_b[:, 3] = 1.0
        self.pose_command_w = torch.zeros_like(self.pose_command_b)
        self.metrics.update(position_error=self._zeros(), orientation_error=self._zeros())

    @property
    def command(self) -> Tensor:
        """Commanded position [m] and quaternion (w, x, y, z), in the robot's root frame. (num_envs, 7)"""
        return self.pose_command_b

    def _update_metrics(self) -> None:
        data, goal = self.robot.data, self.pose_command_b
        world = combine_frame_transforms(data.root_pos_w, data.root_quat_w, goal[:, :3], goal[:, 3:])
        self.pose_command_w[:] = torch.cat(world, dim=1)
        now = data.body_pos_w[:, self.body_idx], data.body_quat_w[:, self.body_idx]
        position, rotation = compute_pose_error(*world, *now)
        self.metrics["position_error"], self.metrics["orientation_error"] = position.norm(dim=1), rotation.norm(dim=1)

    def _resample_command(self, env_ids: Any) -> None:
        ranges = self.cfg.ranges
        for column, name in enumerate(("pos_x", "pos_y", "pos_z")):
            self.pose_command_b[env_ids, column] = self._sample(env_ids, getattr(ranges, name))
        quat = quat_from_euler_xyz(*(self._sample(env_ids, ends) for ends in (ranges.roll, ranges.pitch, ranges.yaw)))
        self.pose_command_b[env_ids, 3:] = quat_unique(quat) if self.cfg.make_quat_unique else quat


class UniformPose2dCommand(_RobotCommand):
    """Command of a position and a heading on the ground, in the robot's frame."""

    elements = ("ahead", "left", "", "turn")
    units = ("m", "m", "m", "rad")

    def __init__(self, cfg: Any, env: Any) -> None:
        super().__init__(cfg, env)
        self.pos_command_w, self.pos_command_b = self._zeros(3), self._zeros(3)
        self.heading_command_w, self.heading_command_b = self._zeros(), self._zeros()
        self.metrics.update(error_pos_2d=self._zeros(), error_heading=self._zeros())

    @property
    def command(self) -> Tensor:
        """Vector to the commanded position [m], and angle to the heading [rad], in the root frame. (num_envs, 4)"""
        return torch.cat([self.pos_command_b, self.heading_command_b[:, None]], dim=1)

    def _update_metrics(self) -> None:
        error = self.pos_command_w[:, :2] - self.robot.data.root_pos_w[:, :2]
        self.metrics["error_pos_2d"] = error.norm(dim=1)
        self.metrics["error_heading"] = wrap_to_pi(self.heading_command_w - self.robot.data.heading_w).abs()

    def _resample_command(self, env_ids: Any) -> None:
        data, ranges = self.robot.data, self.cfg.ranges
        goal = self._env.scene.env_origins[env_ids].clone()
        goal[:, 0] += self._sample(env_ids, ranges.pos_x)
        goal[:, 1] += self._sample(env_ids, ranges.pos_y)
        goal[:, 2] += data.default_root_state[env_ids, 2]
        self.pos_command_w[env_ids] = goal
        if not self.cfg.simple_heading:
            self.heading_command_w[env_ids] = self._sample(env_ids, ranges.heading)
            return
        way = goal - data.root_pos_w[env_ids]
        ahead = torch.atan2(way[:, 1], way[:, 0])
        behind = wrap_to_pi(ahead + torch.pi)
        now = data.heading_w[env_ids]
        is_nearer = wrap_to_pi(ahead - now).abs() < wrap_to_pi(behind - now).abs()
        self.heading_command_w[env_ids] = torch.where(is_nearer, ahead, behind)

    def _update_command(self) -> None:
        data = self.robot.data
        self.pos_command_b[:] = quat_apply_inverse(yaw_quat(data.root_quat_w), self.pos_command_w - data.root_pos_w)
        self.heading_command_b[:] = wrap_to_pi(self.heading_command_w - data.heading_w)

"""Reward terms of survival, and of the robot's root body (its base): posture, progress, tracking. (num_envs,) each."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rlcli.mdp.parameter_types import Command, Entity, ManagedEnv, RaySensor
from rlcli.mdp.term import EntityTerm, Term
from rlcli.mdp.term_helpers import commanded_speed, constant
from rlcli.scene.names import match
from rlcli.sim.env_selection import Selection
from rlcli.sim.rotations import length, roll_pitch_yaw
from rlcli.sim.saved_tensors import TensorState
from rlcli.task import Bodies, Sensors, reads_body_forces

# --- survival ---


def is_alive(env: ManagedEnv) -> Tensor:
    """1 unless the episode was terminated in this step. A time-out counts as alive. (num_envs,)"""
    return ~env.termination_manager.terminated


def is_terminated(env: ManagedEnv) -> Tensor:
    """1 where the episode was terminated in this step. A time-out does not count. (num_envs,)"""
    return env.termination_manager.terminated


@dataclass(kw_only=True, eq=False)
class IsTerminatedTerm(Term):
    """Number of the terminations `terms` that ended the episode in this step; 0 on a time-out. (num_envs,)

    terms: names or regexes of terminations.
    """

    terms: str | list[str] = ".*"

    def __post_init__(self) -> None:
        known = [name for name, config in self.env.config.terminations.items() if config is not None]
        self._names = [known[position] for position in match(self.terms, known, "termination")]

    def __call__(self) -> Tensor:
        """Return the value of the reward term. (num_envs,)"""
        manager = self.env.termination_manager
        fired = torch.zeros_like(manager.terminated, dtype=torch.float32)
        for name in self._names:
            fired = fired + manager.fired[name]
        return fired * ~manager.time_outs


# --- motion and posture of the root ---


def lin_vel_z_l2(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Square of the vertical velocity of the root, in its own frame [m^2/s^2]. (num_envs,)"""
    return entity.data.root_lin_vel_b[:, 2].square()


def ang_vel_xy_l2(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Sum of the squared roll and pitch rates of the root, in its own frame [rad^2/s^2]. (num_envs,)"""
    return entity.data.root_ang_vel_b[:, :2].square().sum(dim=1)


def flat_orientation_l2(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """g_x^2 + g_y^2 of gravity's direction g in the root's frame: 0 upright, 1 lying on its side. (num_envs,)"""
    return entity.data.projected_gravity_b[:, :2].square().sum(dim=1)


def upright_posture_bonus(env: ManagedEnv, *, entity: Entity = "robot", threshold: float) -> Tensor:
    """1 where the cosine between the root's up axis and the world's is above `threshold`. (num_envs,)"""
    return -entity.data.projected_gravity_b[:, 2] > threshold


def base_height_l2(
    env: ManagedEnv, *, entity: Entity = "robot", target_height: float, sensor: RaySensor | None = None
) -> Tensor:
    """Square of the difference between the root's height and `target_height` [m^2]. (num_envs,)

    target_height: above the environment's origin [m]; with a sensor, above the mean height of the points that its rays
    hit.
    """
    ground = env.origins[:, 2] if sensor is None else sensor.hits[:, :, 2].mean(dim=1)
    return (entity.data.root_pos_w[:, 2] - ground - target_height).square_()


def upright(env: ManagedEnv, *, entity: Entity = "robot", std: float) -> Tensor:
    """exp(-(g_x^2 + g_y^2) / std^2) of gravity's direction g in the root's frame. (num_envs,)  mjlab: `upright`."""
    return _bell(entity.data.projected_gravity_b[:, :2].square().sum(dim=1), std)


def base_motion_penalty(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """0.8 v_z^2 + 0.2 (|w_x| + |w_y|) of the root, in its own frame [m/s, rad/s]. (num_envs,)"""
    data = entity.data
    return 0.8 * data.root_lin_vel_b[:, 2].square() + 0.2 * data.root_ang_vel_b[:, :2].abs().sum(dim=1)


def base_orientation_penalty(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """sqrt(g_x^2 + g_y^2) of gravity's direction g in the root's frame: 0 upright, 1 on its side. (num_envs,)"""
    return length(entity.data.projected_gravity_b[:, :2])


def lin_vel_xyz_exp(env: ManagedEnv, *, entity: Entity = "robot", std: float) -> Tensor:
    """exp(-|v|^2 / std^2) of the root's linear velocity v; std [m/s]. (num_envs,)"""
    return _bell(entity.data.root_lin_vel_w.square().sum(dim=1), std)


def ang_vel_xyz_exp(env: ManagedEnv, *, entity: Entity = "robot", std: float) -> Tensor:
    """exp(-|w|^2 / std^2) of the root's angular velocity w; std [rad/s]. (num_envs,)"""
    return _bell(entity.data.root_ang_vel_b.square().sum(dim=1), std)


def yaw_aligned(env: ManagedEnv, *, entity: Entity = "robot", std: float = 0.5) -> Tensor:
    """exp(-yaw^2 / std^2) of the root; std [rad]. (num_envs,)"""
    return _bell(roll_pitch_yaw(entity.data.root_quat_w)[2].square(), std)


# --- way to a target point ---


def move_to_target_bonus(
    env: ManagedEnv, *, entity: Entity = "robot", threshold: float, target: tuple[float, float, float]
) -> Tensor:
    """Cosine between the root's heading and the way to `target`, divided by `threshold`, at most 1. (num_envs,)

    target: a point from the environment's origin [m].
    """
    to_target = constant(target, env.device)[:2] + env.origins[:, :2] - entity.data.root_pos_w[:, :2]
    forward = entity.data.forward_w
    heading = (forward[:, 0] * to_target[:, 0] + forward[:, 1] * to_target[:, 1]) / _norm_xy(to_target).clamp_(min=1e-9)
    return torch.where(heading > threshold, 1.0, heading / threshold)


@dataclass(kw_only=True, eq=False)
class ProgressReward(EntityTerm, TensorState):
    """Speed at which the horizontal distance from the root to `target` decreases [m/s]. (num_envs,)

    target: a point from the environment's origin [m]. The speed is computed from the root's displacement in the step.
    The difference of two distances would be inexact: 32-bit floats resolve a distance of 1 km to 0.06 mm, which is
    4 mm/s at 60 Hz.
    """

    target: tuple[float, float, float]

    def __post_init__(self) -> None:
        self._target_xy = constant(self.target, self.env.device)[:2]
        self._position = self.entity.data.root_pos_w[:, :2].clone()

    def __call__(self) -> Tensor:
        """Return the value of the reward term. (num_envs,)"""
        position = self.entity.data.root_pos_w[:, :2]
        ahead, ahead_before = self._target_from(position), self._target_from(self._position)
        # |b| - |a| = (b - a) (b + a) / (|b| + |a|), with b - a computed from the short displacement of one step
        gained = _dot_xy(position - self._position, ahead + ahead_before)
        progress = gained / ((_norm_xy(ahead) + _norm_xy(ahead_before)).clamp_(min=1e-9) * self.env.step_dt)
        self._position.copy_(position)
        return progress

    def reset(self, selection: Selection) -> None:
        """Store the start positions of new episodes; reset events have already written them."""
        # read qpos, because derived positions are computed only after all terms are reset
        first, _ = self.entity.floating()
        position = selection.read(self.entity.engine.field("qpos"), slice(first, first + 2)).float()
        selection.write(self._position, position)

    def tensors(self) -> dict[str, Tensor]:
        """Return the position of the root in the last step."""
        return {"position": self._position}

    def _target_from(self, position: Tensor) -> Tensor:
        return self._target_xy + self.env.origins[:, :2] - position


# --- motion of any bodies ---


@reads_body_forces
def body_lin_acc_l2(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies = ".*") -> Tensor:
    """Sum of the magnitudes of the accelerations of bodies in the last substep, not squared [m/s^2]. (num_envs,)"""
    return length(entity.data.body_lin_acc_w[:, bodies]).sum(dim=1)


def body_angular_velocity_penalty(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies) -> Tensor:
    """Sum of the squared roll and pitch rates of bodies, each in its own frame [rad^2/s^2]. (num_envs,)

    mjlab: `body_angular_velocity_penalty`.
    """
    return entity.data.body_ang_vel_b[:, bodies, :2].square().sum(dim=-1).sum(dim=1)


def angular_momentum_penalty(env: ManagedEnv, *, entity: Entity = "robot", sensors: Sensors) -> Tensor:
    """Sum of the squared readings of `subtreeangmom` sensors in the MJCF [kg^2 m^4/s^2]. (num_envs,)

    mjlab: `angular_momentum_penalty`.
    """
    return entity.data.sensordata[:, sensors].square().sum(dim=1)


# --- velocity commands: (x, y) in the root's frame [m/s], about z [rad/s] ---


def track_lin_vel_xy_exp(env: ManagedEnv, *, entity: Entity = "robot", command: Command, std: float) -> Tensor:
    """exp(-|c - v|^2 / std^2) of the commanded and the actual horizontal velocity; std [m/s]. (num_envs,)

    Both are in the root's frame.
    """
    return _bell((command.command[:, :2] - entity.data.root_lin_vel_b[:, :2]).square_().sum(dim=1), std)


def track_ang_vel_z_exp(env: ManagedEnv, *, entity: Entity = "robot", command: Command, std: float) -> Tensor:
    """exp(-(c_z - w_z)^2 / std^2) of the commanded and the actual yaw rate; std [rad/s]. (num_envs,)

    Both are in the root's frame.
    """
    return _bell((command.command[:, 2] - entity.data.root_ang_vel_b[:, 2]).square_(), std)


def track_lin_vel_xy_yaw_frame_exp(
    env: ManagedEnv, *, entity: Entity = "robot", command: Command, std: float
) -> Tensor:
    """`track_lin_vel_xy_exp` in the root's yaw frame: the world frame turned by the root's heading. (num_envs,)"""
    ahead = entity.data.forward_w[:, :2]
    ahead = ahead / length(ahead).clamp_(min=1e-9)[:, None]
    v = entity.data.root_lin_vel_w
    x = ahead[:, 0] * v[:, 0] + ahead[:, 1] * v[:, 1]
    y = ahead[:, 0] * v[:, 1] - ahead[:, 1] * v[:, 0]
    return _bell((command.command[:, 0] - x).square_() + (command.command[:, 1] - y).square_(), std)


def track_ang_vel_z_world_exp(env: ManagedEnv, *, entity: Entity = "robot", command: Command, std: float) -> Tensor:
    """`track_ang_vel_z_exp` with the rate about the world's vertical axis. (num_envs,)"""
    return _bell((command.command[:, 2] - entity.data.root_ang_vel_w[:, 2]).square_(), std)


def track_linear_velocity(env: ManagedEnv, *, entity: Entity = "robot", command: Command, std: float) -> Tensor:
    """`track_lin_vel_xy_exp` with the root's v_z^2 added to the error. (num_envs,)  mjlab: `track_linear_velocity`."""
    velocity = entity.data.root_lin_vel_b
    plane = (command.command[:, :2] - velocity[:, :2]).square_().sum(dim=1)
    return _bell(plane + velocity[:, 2].square(), std)


def track_angular_velocity(env: ManagedEnv, *, entity: Entity = "robot", command: Command, std: float) -> Tensor:
    """`track_ang_vel_z_exp` with w_x^2 + w_y^2 added to the error. (num_envs,)  mjlab: `track_angular_velocity`."""
    velocity = entity.data.root_ang_vel_b
    return _bell((command.command[:, 2] - velocity[:, 2]).square_() + velocity[:, :2].square().sum(dim=1), std)


def base_linear_velocity_reward(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    command: Command,
    std: float,
    ramp_at_vel: float = 1.0,
    ramp_rate: float = 0.5,
) -> Tensor:
    """exp(-|c - v| / std) max(1, 1 + ramp_rate (|c| - ramp_at_vel)) of horizontal velocities. (num_envs,)

    c: the command, v: the root's velocity in its own frame. std, ramp_at_vel [m/s], ramp_rate [s/m].
    """
    error = length(command.command[:, :2] - entity.data.root_lin_vel_b[:, :2])
    factor = (1.0 + ramp_rate * (commanded_speed(command) - ramp_at_vel)).clamp_(min=1.0)
    return torch.exp(-error / std) * factor


def base_angular_velocity_reward(env: ManagedEnv, *, entity: Entity = "robot", command: Command, std: float) -> Tensor:
    """exp(-|c_z - w_z| / std) of the commanded and the actual yaw rate; std [rad/s]. (num_envs,)"""
    return torch.exp(-(command.command[:, 2] - entity.data.root_ang_vel_b[:, 2]).abs() / std)


def heading_command_error_abs(env: ManagedEnv, *, command: Command) -> Tensor:
    """Absolute angle to the commanded heading: the fourth column of a command (x, y, z, angle) [rad]. (num_envs,)"""
    return command.command[:, 3].abs()


def distance_to_goal_exp(env: ManagedEnv, *, entity: Entity = "robot", command: Command, std: float) -> Tensor:
    """exp(-distance^2 / std^2) from the root to a position command; std [m]. (num_envs,)

    The command is a position from the environment's origin [m].
    """
    offset = command.command[:, :3] + env.origins - entity.data.root_pos_w
    return _bell(offset.square_().sum(dim=1), std)


def _bell(squared: Tensor, std: float) -> Tensor:
    return torch.exp(-squared / (std * std))


def _dot_xy(left: Tensor, right: Tensor) -> Tensor:
    return left[:, 0] * right[:, 0] + left[:, 1] * right[:, 1]


def _norm_xy(vector: Tensor) -> Tensor:
    return (vector[:, 0].square() + vector[:, 1].square()).sqrt_()

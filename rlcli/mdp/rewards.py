"""Reward terms, unsigned and unweighted: the YAML's `weight` gives sign and size. (num_envs,) each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rlcli.mdp.measures import (
    asked_speed,
    every,
    goal_in_world,
    goal_quat_in_world,
    only,
    paired,
    strongest_force,
    total,
    vector,
)
from rlcli.sim.rotations import axis_x, axis_y, axis_z, length, roll_pitch_yaw, turn_between
from rlcli.sim.selection import Columns, Selection
from rlcli.task import Bodies, Command, ContactSensor, Entity, Joints, RaySensor, Sensors, Sites, reads_body_forces

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv


def is_alive(env: ManagedEnv) -> Tensor:
    """1 unless the episode was terminated in this step; 1 on a time-out. (num_envs,)"""
    return ~env.termination_manager.terminated


def is_terminated(env: ManagedEnv) -> Tensor:
    """1 where the episode was terminated in this step; 0 on a time-out. (num_envs,)"""
    return env.termination_manager.terminated


def joint_pos_target_l2(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", target: float) -> Tensor:
    """Squared joint deviation from `target` [rad^2], positions wrapped to [-pi, pi]. (num_envs,)"""
    angle = entity.data.joint_angle_of(joints)
    deviation = angle - target if isinstance(target, Tensor) or target else angle
    return total(deviation.square())


def joint_vel_l1(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of absolute joint velocities [rad/s]. (num_envs,)"""
    return total(entity.data.joint_vel_of(joints).abs())


def joint_vel_l2(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of squared joint velocities [rad^2/s^2]. (num_envs,)"""
    return total(entity.data.joint_vel_of(joints).square())


def joint_acc_l2(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of squared joint accelerations over the last substep [rad^2/s^4]. (num_envs,)"""
    return total(entity.data.joint_acc[:, joints].square())


def joint_torques_l2(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of squared actuator efforts on the joints, after their limits [N^2 m^2]. (num_envs,)"""
    return total(entity.data.applied_effort[:, joints].square())


def joint_pos_limits(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """How far joints are outside their soft limits, summed [rad]. (num_envs,)"""
    position = entity.data.joint_pos_of(joints)
    low, high = entity.data.joint_limits_of(joints, soft=True)
    return ((low - position).clamp_(min=0.0) + (position - high).clamp_(min=0.0)).sum(dim=1)


class JointPosLimitsPenaltyRatio:
    """How far beyond `threshold` of their range joints are, as a share of what is left of it, summed. (num_envs,)

    gear_ratio: what each joint counts, one for all or one each, in the order of `joints`.
    """

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints = ".*",
        threshold: float = 0.98,
        gear_ratio: float | list[float] = 1.0,
    ) -> None:
        self._entity, self._joints, self._threshold = entity, joints, threshold
        self._ratio = _spread(gear_ratio, entity, joints, env.device, "gear_ratio")

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        low, high = (limit[:, self._joints] for limit in self._entity.data.joint_limits())
        scaled = ((2.0 * self._entity.data.joint_pos_of(self._joints) - low - high) / (high - low)).abs()
        violation = (scaled - self._threshold) / (1.0 - self._threshold)
        # a joint without limits has no scale (nan), and is never beyond it
        return torch.where(scaled > self._threshold, violation * self._ratio, 0.0).sum(dim=1)


def joints_at_limit(
    env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", threshold: float = 0.99
) -> Tensor:
    """How many joints are beyond `threshold` of their range, -1 and 1 at the soft limits. (num_envs,)

    A joint without limits never is.
    """
    low, high = entity.data.joint_limits_of(joints, soft=True)
    scaled = (2.0 * entity.data.joint_pos_of(joints) - low - high) / (high - low)
    return (scaled.abs_() > threshold).sum(dim=1).float()


class PowerConsumption:
    """Sum of |raw action x joint velocity x gear ratio|; `joints` are the driven ones, in the action's order [rad/s].

    gear_ratio: one for all or one each, in the order of `joints`. (num_envs,)
    """

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints = ".*",
        gear_ratio: float | list[float] = 1.0,
    ) -> None:
        self._env, self._entity, self._joints = env, entity, joints
        self._ratio = _spread(gear_ratio, entity, joints, env.device, "gear_ratio")

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        action, velocity = self._env.action_manager.action, self._entity.data.joint_vel_of(self._joints)
        if action.shape != velocity.shape:
            raise ValueError(f"selects {velocity.shape[1]} joints, the action has {action.shape[1]} columns")
        return (action * velocity * self._ratio).abs().sum(dim=1)


def action_rate_l2(env: ManagedEnv) -> Tensor:
    """Sum of squared changes of the policy's action. (num_envs,)"""
    return (env.action_manager.action - env.action_manager.prev_action).square_().sum(dim=1)


def action_l2(env: ManagedEnv) -> Tensor:
    """Sum of squares of the policy's action. (num_envs,)"""
    return env.action_manager.action.square().sum(dim=1)


def lin_vel_z_l2(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Squared vertical velocity of the root, in its own frame [m^2/s^2]. (num_envs,)"""
    return entity.data.root_lin_vel_b[:, 2].square()


def ang_vel_xy_l2(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Squared roll and pitch rates of the root, in its own frame [rad^2/s^2]. (num_envs,)"""
    return entity.data.root_ang_vel_b[:, :2].square().sum(dim=1)


def flat_orientation_l2(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Squared horizontal part of gravity's direction in the root's frame: 0 upright, 1 on its side. (num_envs,)"""
    return entity.data.projected_gravity_b[:, :2].square().sum(dim=1)


def upright_posture_bonus(env: ManagedEnv, *, entity: Entity = "robot", threshold: float) -> Tensor:
    """1 where the root's up axis is within acos(threshold) of the world's. (num_envs,)"""
    return -entity.data.projected_gravity_b[:, 2] > threshold


def move_to_target_bonus(
    env: ManagedEnv, *, entity: Entity = "robot", threshold: float, target: tuple[float, float, float]
) -> Tensor:
    """1 where the root heads for `target` to within acos(threshold), else a share of it. (num_envs,)"""
    to_target = vector(target, env.device)[:2] + env.origins[:, :2] - entity.data.root_pos_w[:, :2]
    forward = entity.data.forward_w
    heading = (forward[:, 0] * to_target[:, 0] + forward[:, 1] * to_target[:, 1]) / _norm_xy(to_target).clamp_(min=1e-9)
    return torch.where(heading > threshold, 1.0, heading / threshold)


class ProgressReward:
    """Speed at which the root comes nearer to `target`, horizontally [m/s]. (num_envs,)

    Of the way since the last step, not of two distances: those to a target 1 km away are known to 0.06 mm only, which
    is 4 mm/s at 60 Hz.
    """

    def __init__(self, env: ManagedEnv, *, entity: Entity = "robot", target: tuple[float, float, float]) -> None:
        self._entity, self._dt = entity, env.step_dt
        self._origins, self._target = env.origins, vector(target, env.device)[:2]
        self._position = entity.data.root_pos_w[:, :2].clone()

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        now = self._entity.data.root_pos_w[:, :2]
        ahead, ahead_before = self._target_from(now), self._target_from(self._position)
        # |a| - |b| = (a - b) (a + b) / (|a| + |b|)
        gained = _dot_xy(now - self._position, ahead + ahead_before)
        progress = gained / ((_norm_xy(ahead) + _norm_xy(ahead_before)).clamp_(min=1e-9) * self._dt)
        self._position.copy_(now)
        return progress

    def reset(self, selection: Selection) -> None:
        """The first step of an episode compares with its start state, which is set by now."""
        position = selection.read(self._entity.engine.field("qpos"), _xy(self._entity)).float()
        selection.write(self._position, position)

    def state_dict(self) -> dict[str, Tensor]:
        """Where the root was in the last step."""
        return {"position": self._position.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take back what `state_dict` gave."""
        self._position.copy_(state["position"])

    def _target_from(self, position: Tensor) -> Tensor:
        return self._target + self._origins[:, :2] - position


# --- episodes and actions ---


class IsTerminatedTerm:
    """How many of the terminations `terms` ended the episode in this step; 0 on a time-out. (num_envs,)"""

    def __init__(self, env: ManagedEnv, *, terms: list[str]) -> None:
        known = [name for name, config in env.config.terminations.items() if config is not None]
        for name in terms:
            if name not in known:
                raise ValueError(f"no termination '{name}'; terminations: {', '.join(known) or 'none'}")
        self._env, self._terms = env, terms

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        manager = self._env.termination_manager
        fired = torch.zeros_like(manager.terminated, dtype=torch.float32)
        for name in self._terms:
            fired = fired + manager.fired[name]
        return fired * ~manager.time_outs


class ActionAccL2:
    """Sum of squared second differences of the policy's action, a - 2 a' + a''. (num_envs,)  mjlab: `action_acc_l2`."""

    def __init__(self, env: ManagedEnv) -> None:
        self._env = env
        self._before: Tensor | None = None

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        action, previous = self._env.action_manager.action, self._env.action_manager.prev_action
        if self._before is None:
            self._before = torch.zeros_like(action)
        change = action - 2.0 * previous + self._before
        self._before.copy_(previous)
        return change.square_().sum(dim=1)

    def reset(self, selection: Selection) -> None:
        """New episodes begin without past actions."""
        if self._before is not None:
            selection.write(self._before, 0.0)

    def state_dict(self) -> dict[str, Tensor]:
        """The action before the previous one."""
        return {"before": self._before.clone()} if self._before is not None else {}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take back what `state_dict` gave."""
        self._before = state["before"].clone()


def action_smoothness_penalty(env: ManagedEnv) -> Tensor:
    """Size of the change of the policy's action. (num_envs,)"""
    return length(env.action_manager.action - env.action_manager.prev_action)


# --- the root ---


def base_height_l2(
    env: ManagedEnv, *, entity: Entity = "robot", target_height: float, sensor: RaySensor | None = None
) -> Tensor:
    """Squared deviation of the root's height from `target_height` [m^2]. (num_envs,)

    target_height: above the environment's origin [m]; with a sensor, above the mean height of what its rays hit.
    """
    ground = env.origins[:, 2] if sensor is None else sensor.hits[:, :, 2].mean(dim=1)
    return (entity.data.root_pos_w[:, 2] - ground - target_height).square_()


def upright(env: ManagedEnv, *, entity: Entity = "robot", std: float) -> Tensor:
    """exp(-(g_x^2 + g_y^2) / std^2) of gravity's direction g in the root's frame. (num_envs,)  mjlab: `upright`."""
    return _bell(entity.data.projected_gravity_b[:, :2].square().sum(dim=1), std)


def base_motion_penalty(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """0.8 v_z^2 + 0.2 (|w_x| + |w_y|) of the root, in its own frame. (num_envs,)"""
    data = entity.data
    return 0.8 * data.root_lin_vel_b[:, 2].square() + 0.2 * data.root_ang_vel_b[:, :2].abs().sum(dim=1)


def base_orientation_penalty(env: ManagedEnv, *, entity: Entity = "robot") -> Tensor:
    """Size of the horizontal part of gravity's direction in the root's frame: 0 upright, 1 on its side. (num_envs,)"""
    return length(entity.data.projected_gravity_b[:, :2])


def lin_vel_xyz_exp(env: ManagedEnv, *, entity: Entity = "robot", std: float) -> Tensor:
    """exp(-|v|^2 / std^2) of the root's velocity; std [m/s]. (num_envs,)"""
    return _bell(entity.data.root_lin_vel_w.square().sum(dim=1), std)


def ang_vel_xyz_exp(env: ManagedEnv, *, entity: Entity = "robot", std: float) -> Tensor:
    """exp(-|w|^2 / std^2) of the root's angular velocity; std [rad/s]. (num_envs,)"""
    return _bell(entity.data.root_ang_vel_b.square().sum(dim=1), std)


def yaw_aligned(env: ManagedEnv, *, entity: Entity = "robot", std: float = 0.5) -> Tensor:
    """exp(-yaw^2 / std^2) of the root; std [rad]. (num_envs,)"""
    return _bell(roll_pitch_yaw(entity.data.root_quat_w)[2].square(), std)


# --- bodies ---


@reads_body_forces
def body_lin_acc_l2(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies = ".*") -> Tensor:
    """Sum of squared accelerations of the bodies' origins over the last substep [m^2/s^4]. (num_envs,)"""
    return entity.data.body_lin_acc_w[:, bodies].square().sum(dim=-1).sum(dim=1)


def body_angular_velocity_penalty(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies) -> Tensor:
    """Sum of squared roll and pitch rates of bodies, each in its own frame [rad^2/s^2]. (num_envs,)

    mjlab: `body_angular_velocity_penalty`.
    """
    return entity.data.body_ang_vel_b[:, bodies, :2].square().sum(dim=-1).sum(dim=1)


def angular_momentum_penalty(env: ManagedEnv, *, entity: Entity = "robot", sensors: Sensors) -> Tensor:
    """Sum of squared readings of `subtreeangmom` sensors of the MJCF [kg^2 m^4/s^2]. (num_envs,)

    mjlab: `angular_momentum_penalty`.
    """
    return entity.data.sensordata[:, sensors].square().sum(dim=1)


# --- joints ---


def joint_deviation_l1(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of absolute deviations of joints from their defaults [rad]. (num_envs,)"""
    return _off_default(entity, joints).abs().sum(dim=1)


def stand_still_joint_deviation_l1(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    joints: Joints = ".*",
    command: Command,
    command_threshold: float = 0.06,
) -> Tensor:
    """`joint_deviation_l1` [rad] where a velocity command asks for less than `command_threshold` [m/s]. (num_envs,)"""
    return _off_default(entity, joints).abs().sum(dim=1) * (asked_speed(command) < command_threshold)


def joint_vel_limits(
    env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", soft_ratio: float = 1.0
) -> Tensor:
    """How much faster joints are than `soft_ratio` x their `velocity_limit`, each at most 1, summed. (num_envs,)

    [m/s or rad/s]
    """
    excess = entity.data.joint_vel_of(joints).abs() - entity.data.joint_vel_limits[joints] * soft_ratio
    return excess.clamp_(0.0, 1.0).sum(dim=1)


def joint_velocity_hinge_penalty(
    env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", max_velocity: float
) -> Tensor:
    """Sum of squares of how much faster joints are than `max_velocity` [rad^2/s^2]. (num_envs,)

    mjlab: `joint_velocity_hinge_penalty`.
    """
    return (entity.data.joint_vel_of(joints).abs() - max_velocity).clamp_(min=0.0).square_().sum(dim=1)


def applied_torque_limits(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """How much of what actuators were to give their limits withhold, summed [N or N m]. (num_envs,)

    MuJoCo's own actuators by the present state and controls. Isaac Lab: explicit actuators only, of the last substep.
    """
    return entity.data.withheld_effort[:, joints].sum(dim=1)


def electrical_power_cost(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Mechanical power that actuators put into joints, without what they take out, summed [W]. (num_envs,)

    mjlab: `electrical_power_cost`.
    """
    power = entity.data.applied_effort[:, joints] * entity.data.joint_vel_of(joints)
    return power.clamp_(min=0.0).sum(dim=1)


def joint_acceleration_penalty(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Size of the joints' accelerations over the last substep [rad/s^2]. (num_envs,)"""
    return length(entity.data.joint_acc[:, joints])


def joint_torques_penalty(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Size of the actuators' efforts on the joints, after their limits [N m]. (num_envs,)"""
    return length(entity.data.applied_effort[:, joints])


def joint_velocity_penalty(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Size of the joints' velocities [rad/s]. (num_envs,)"""
    return length(entity.data.joint_vel_of(joints))


def joint_position_penalty(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    joints: Joints = ".*",
    command: Command,
    stand_still_scale: float,
    velocity_threshold: float,
) -> Tensor:
    """Size of the joints' deviation from their defaults, times `stand_still_scale` at a stand [rad]. (num_envs,)

    At a stand: nothing is asked, and the root is slower than `velocity_threshold` [m/s].
    """
    deviation = length(_off_default(entity, joints))
    return torch.where(_on_the_move(entity, command, velocity_threshold), deviation, stand_still_scale * deviation)


class Posture:
    """exp(-mean of (deviation from default / std)^2) over the joints. (num_envs,)  mjlab: `posture`.

    std: how far joints may be off [rad], one for all or one each, in the order of `joints`.
    """

    def __init__(
        self, env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", std: float | list[float]
    ) -> None:
        self._entity, self._joints = entity, joints
        self._std = _spread(std, entity, joints, env.device)

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        return (_off_default(self._entity, self._joints) / self._std).square_().mean(dim=1).neg_().exp_()


class VariablePosture:
    """`posture` with another `std` at a stand, at a walk and at a run. (num_envs,)  mjlab: `variable_posture`.

    By the speed that a velocity command asks for, in the plane [m/s] and about the vertical [rad/s] added up: below
    `walking_threshold` at a stand, from `running_threshold` on at a run.
    """

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints = ".*",
        command: Command,
        std_standing: float | list[float],
        std_walking: float | list[float],
        std_running: float | list[float],
        walking_threshold: float = 0.5,
        running_threshold: float = 1.5,
    ) -> None:
        self._entity, self._joints, self._command = entity, joints, command
        self._standing, self._walking, self._running = (
            _spread(std, entity, joints, env.device) for std in (std_standing, std_walking, std_running)
        )
        self._walk_from, self._run_from = walking_threshold, running_threshold

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        speed = (asked_speed(self._command) + self._command.command[:, 2].abs())[:, None]
        std = torch.where(speed < self._walk_from, self._standing, self._walking)
        std = torch.where(speed < self._run_from, std, self._running)
        return (_off_default(self._entity, self._joints) / std).square_().mean(dim=1).neg_().exp_()


# --- velocity commands: (x, y) in the root's frame [m/s], about z [rad/s] ---


def track_lin_vel_xy_exp(env: ManagedEnv, *, entity: Entity = "robot", command: Command, std: float) -> Tensor:
    """exp(-|c - v|^2 / std^2) of the plane velocity asked for and the root's, in its frame; std [m/s]. (num_envs,)"""
    return _bell((command.command[:, :2] - entity.data.root_lin_vel_b[:, :2]).square_().sum(dim=1), std)


def track_ang_vel_z_exp(env: ManagedEnv, *, entity: Entity = "robot", command: Command, std: float) -> Tensor:
    """exp(-(c_z - w_z)^2 / std^2) of the turn rate asked for and the root's, in its frame; std [rad/s]. (num_envs,)"""
    return _bell((command.command[:, 2] - entity.data.root_ang_vel_b[:, 2]).square_(), std)


def track_lin_vel_xy_yaw_frame_exp(
    env: ManagedEnv, *, entity: Entity = "robot", command: Command, std: float
) -> Tensor:
    """`track_lin_vel_xy_exp` in the root's heading frame: upright, turned about the vertical only. (num_envs,)"""
    ahead = entity.data.forward_w[:, :2]
    ahead = ahead / length(ahead).clamp_(min=1e-9)[:, None]
    v = entity.data.root_lin_vel_w
    x = ahead[:, 0] * v[:, 0] + ahead[:, 1] * v[:, 1]
    y = ahead[:, 0] * v[:, 1] - ahead[:, 1] * v[:, 0]
    return _bell((command.command[:, 0] - x).square_() + (command.command[:, 1] - y).square_(), std)


def track_ang_vel_z_world_exp(env: ManagedEnv, *, entity: Entity = "robot", command: Command, std: float) -> Tensor:
    """`track_ang_vel_z_exp` with the turn rate about the world's vertical. (num_envs,)"""
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
    """exp(-|c - v| / std) x max(1, 1 + ramp_rate (|c| - ramp_at_vel)), c and v in the plane; std [m/s]. (num_envs,)"""
    error = length(command.command[:, :2] - entity.data.root_lin_vel_b[:, :2])
    factor = (1.0 + ramp_rate * (asked_speed(command) - ramp_at_vel)).clamp_(min=1.0)
    return torch.exp(-error / std) * factor


def base_angular_velocity_reward(env: ManagedEnv, *, entity: Entity = "robot", command: Command, std: float) -> Tensor:
    """exp(-|c_z - w_z| / std) of the turn rate asked for and the root's; std [rad/s]. (num_envs,)"""
    return torch.exp(-(command.command[:, 2] - entity.data.root_ang_vel_b[:, 2]).abs() / std)


# --- contacts and feet ---


def undesired_contacts(env: ManagedEnv, *, sensor: ContactSensor, threshold: float = 1.0) -> Tensor:
    """How many bodies of the sensor felt more than `threshold` [N] within its history. (num_envs,)"""
    return (strongest_force(sensor) > threshold).sum(dim=1).float()


def desired_contacts(env: ManagedEnv, *, sensor: ContactSensor, threshold: float = 1.0) -> Tensor:
    """1 where no body of the sensor felt more than `threshold` [N] within its history: a penalty. (num_envs,)"""
    return every(strongest_force(sensor) <= threshold)


def contact_forces(env: ManagedEnv, *, sensor: ContactSensor, threshold: float) -> Tensor:
    """How much more than `threshold` bodies of the sensor felt within its history, summed [N]. (num_envs,)"""
    return (strongest_force(sensor) - threshold).clamp_(min=0.0).sum(dim=1)


def self_collision_cost(env: ManagedEnv, *, sensor: ContactSensor) -> Tensor:
    """How many bodies of the sensor are in contact. (num_envs,)  mjlab: `self_collision_cost`."""
    return sensor.found.sum(dim=1).float()


def feet_air_time(env: ManagedEnv, *, sensor: ContactSensor, command: Command, threshold: float) -> Tensor:
    """Time in the air less `threshold`, of feet that touch down in this step, summed [s]. (num_envs,)

    0 where a velocity command asks for less than 0.1 m/s.
    """
    paid = (sensor.last_air_time - threshold) * sensor.first_contact
    return paid.sum(dim=1) * (asked_speed(command) > 0.1)


def feet_air_time_positive_biped(
    env: ManagedEnv, *, sensor: ContactSensor, command: Command, threshold: float
) -> Tensor:
    """How long one foot alone has been down and the others up, at most `threshold` [s]. (num_envs,)

    0 where a velocity command asks for less than 0.1 m/s.
    """
    down = sensor.contact_time > 0.0
    lasted = torch.where(down, sensor.contact_time, sensor.air_time).amin(dim=1).clamp(max=threshold)
    return lasted * (down.sum(dim=1) == 1) * (asked_speed(command) > 0.1)


def feet_slide(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, sensor: ContactSensor) -> Tensor:
    """Speed in the plane of feet that felt more than 1 N within the sensor's history, summed [m/s]. (num_envs,)

    bodies: those of the sensor, in its order.
    """
    speed = length(paired(entity.data.body_lin_vel_w[:, bodies, :2], sensor))
    return (speed * (strongest_force(sensor) > 1.0)).sum(dim=1)


def foot_slip_penalty(
    env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, sensor: ContactSensor, threshold: float = 1.0
) -> Tensor:
    """`feet_slide` with the force to call a contact, `threshold` [N]. (num_envs,)"""
    speed = length(paired(entity.data.body_lin_vel_w[:, bodies, :2], sensor))
    return (speed * (strongest_force(sensor) > threshold)).sum(dim=1)


def feet_slip(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    sites: Sites,
    sensor: ContactSensor,
    command: Command,
    command_threshold: float = 0.01,
) -> Tensor:
    """Squared speed in the plane of sites whose foot is in contact, summed [m^2/s^2]. (num_envs,)  mjlab: `feet_slip`.

    sites: one a body of the sensor, in its order. 0 where less than `command_threshold` [m/s] is asked for.
    """
    speed = paired(entity.data.site_lin_vel_w[:, sites, :2], sensor).square().sum(dim=-1)
    return (speed * sensor.found).sum(dim=1) * (asked_speed(command) > command_threshold)


def foot_clearance_reward(
    env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, target_height: float, std: float, tanh_mult: float
) -> Tensor:
    """exp(-sum of (z - target)^2 tanh(tanh_mult |v_xy|) / std) over the feet. (num_envs,)

    z: above the environment's origin [m].
    """
    off = (entity.data.body_pos_w[:, bodies, 2] - env.origins[:, 2:3] - target_height).square_()
    moving = torch.tanh(tanh_mult * length(entity.data.body_lin_vel_w[:, bodies, :2]))
    return torch.exp(-(off * moving).sum(dim=1) / std)


def feet_clearance(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    sites: Sites,
    target_height: float,
    command: Command,
    command_threshold: float = 0.01,
) -> Tensor:
    """Sum of |z - target_height| |v_xy| over sites at the feet [m^2/s]. (num_envs,)  mjlab: `feet_clearance`.

    0 where less than `command_threshold` [m/s] is asked for; z: above the environment's origin.
    """
    off = (entity.data.site_pos_w[:, sites, 2] - env.origins[:, 2:3] - target_height).abs_()
    speed = length(entity.data.site_lin_vel_w[:, sites, :2])
    return (off * speed).sum(dim=1) * (asked_speed(command) > command_threshold)


class FeetSwingHeight:
    """(highest z of the swing / target_height - 1)^2 of feet that touch down, summed. (num_envs,)

    mjlab: `feet_swing_height`. sites: one a body of the sensor, in its order; z: above the environment's origin.
    0 where a velocity command asks for less than `command_threshold` [m/s].
    """

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        sites: Sites,
        sensor: ContactSensor,
        command: Command,
        target_height: float,
        command_threshold: float = 0.01,
    ) -> None:
        self._entity, self._sites, self._sensor, self._command = entity, sites, sensor, command
        self._target, self._asked = target_height, command_threshold
        self._origins = env.origins
        self._peak = torch.zeros_like(sensor.air_time)

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        height = paired(self._entity.data.site_pos_w[:, self._sites, 2], self._sensor) - self._origins[:, 2:3]
        torch.maximum(self._peak, height, out=self._peak)
        error = (self._peak / self._target - 1.0).square_() * self._sensor.first_contact
        self._peak *= ~self._sensor.found
        return error.sum(dim=1) * (asked_speed(self._command) > self._asked)

    def reset(self, selection: Selection) -> None:
        """New episodes begin with no swing."""
        selection.write(self._peak, 0.0)

    def state_dict(self) -> dict[str, Tensor]:
        """The highest points so far."""
        return {"peak": self._peak.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take back what `state_dict` gave."""
        self._peak.copy_(state["peak"])


def soft_landing(
    env: ManagedEnv, *, sensor: ContactSensor, command: Command, command_threshold: float = 0.05
) -> Tensor:
    """Contact forces of feet that touch down in this step, summed [N]. (num_envs,)  mjlab: `soft_landing`.

    0 where a velocity command asks for less than `command_threshold` [m/s].
    """
    landing = (length(sensor.force) * sensor.first_contact).sum(dim=1)
    return landing * (asked_speed(command) > command_threshold)


def air_time_reward(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    sensor: ContactSensor,
    command: Command,
    mode_time: float,
    velocity_threshold: float,
) -> Tensor:
    """Rewards steps of up to `mode_time` on the move, and standing at a stand, summed over feet [s]. (num_envs,)

    On the move each foot gives the time since it last touched down or lifted off, and nothing once that is above
    `mode_time`; at a stand its time on the ground less that in the air, within +-`mode_time`. On the move: something is
    asked, or the root is faster than `velocity_threshold` [m/s].
    """
    longest = torch.maximum(sensor.air_time, sensor.contact_time)
    stepping = torch.where(longest < mode_time, longest, 0.0)
    standing = (sensor.contact_time - sensor.air_time).clamp(-mode_time, mode_time)
    moving = _on_the_move(entity, command, velocity_threshold)[:, None]
    return torch.where(moving, stepping, standing).sum(dim=1)


def air_time_variance_penalty(env: ManagedEnv, *, sensor: ContactSensor) -> Tensor:
    """Variance over feet of their last times in the air and in contact, each at most 0.5 s [s^2]. (num_envs,)"""
    return sensor.last_air_time.clamp(max=0.5).var(dim=1) + sensor.last_contact_time.clamp(max=0.5).var(dim=1)


class GaitReward:
    """Rewards a gait in which the feet of each pair move together and the pairs in turn: a trot. (num_envs,)

    The product of exp(-(difference of air times^2 + difference of contact times^2) / std) within each of the two pairs,
    and of the same with the air time of one and the contact time of the other across them; each square is at most
    max_err^2. 0 at a stand: nothing is asked, and the root is slower than `velocity_threshold` [m/s].

    synced_feet_pairs: names of bodies of the sensor.
    """

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        sensor: ContactSensor,
        command: Command,
        std: float,
        max_err: float,
        velocity_threshold: float,
        synced_feet_pairs: tuple[tuple[str, str], tuple[str, str]],
    ) -> None:
        self._entity, self._sensor, self._command = entity, sensor, command
        self._std, self._max_err, self._threshold = std, max_err, velocity_threshold
        known = [name.removeprefix(f"{entity.name}/") for name in sensor.names]
        for name in [name for pair in synced_feet_pairs for name in pair]:
            if name not in known:
                raise ValueError(f"the sensor has no body '{name}'; its bodies: {', '.join(known)}")
        (a, b), (c, d) = [[known.index(name) for name in pair] for pair in synced_feet_pairs]
        self._together = ((a, b), (c, d))
        self._in_turn = ((a, c), (b, d), (a, d), (c, b))

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        air, contact = self._sensor.air_time, self._sensor.contact_time
        error = torch.zeros_like(air[:, 0])
        for one, other in self._together:
            error += self._capped(air[:, one] - air[:, other]) + self._capped(contact[:, one] - contact[:, other])
        for one, other in self._in_turn:
            error += self._capped(air[:, one] - contact[:, other]) + self._capped(contact[:, one] - air[:, other])
        return torch.exp(-error / self._std) * _on_the_move(self._entity, self._command, self._threshold)

    def _capped(self, difference: Tensor) -> Tensor:
        return difference.square_().clamp(max=self._max_err * self._max_err)


# --- pose commands: position and quaternion in the root's frame ---


def position_command_error(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, command: Command) -> Tensor:
    """Distance from a body to the goal of a pose command [m]. (num_envs,)"""
    return length(only(entity.data.body_pos_w[:, bodies], "body") - goal_in_world(entity, command))


def position_command_error_tanh(
    env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, command: Command, std: float
) -> Tensor:
    """1 - tanh(distance / std), the distance from a body to the goal of a pose command; std [m]. (num_envs,)"""
    return _near(length(only(entity.data.body_pos_w[:, bodies], "body") - goal_in_world(entity, command)), std)


def orientation_command_error(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, command: Command) -> Tensor:
    """Angle between a body's attitude and the goal's of a pose command [rad]. (num_envs,)"""
    return turn_between(
        only(entity.data.body_quat_w[:, bodies], "body").contiguous(), goal_quat_in_world(entity, command)
    )


def orientation_command_error_tanh(
    env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, command: Command, std: float
) -> Tensor:
    """1 - tanh(angle / std), the angle between a body's attitude and the goal's; std [rad]. (num_envs,)"""
    return _near(orientation_command_error(env, entity=entity, bodies=bodies, command=command), std)


def goal_distance_tanh(env: ManagedEnv, *, command: Command, std: float) -> Tensor:
    """1 - tanh(distance / std) to the goal of a pose command of the root itself; std [m]. (num_envs,)

    Isaac Lab: `position_command_error_tanh` of its navigation task.
    """
    return _near(length(command.command[:, :3]), std)


def heading_command_error_abs(env: ManagedEnv, *, command: Command) -> Tensor:
    """Absolute value of the fourth column of a command (x, y, z, heading), the turn still to make [rad]. (num_envs,)"""
    return command.command[:, 3].abs()


def distance_to_goal_exp(env: ManagedEnv, *, entity: Entity = "robot", command: Command, std: float) -> Tensor:
    """exp(-distance^2 / std^2) from the root to a position command; std [m]. (num_envs,)

    The command is in the environment's frame.
    """
    way = command.command[:, :3] + env.origins - entity.data.root_pos_w
    return _bell(way.square_().sum(dim=1), std)


# --- objects and handles ---


def object_is_lifted(env: ManagedEnv, *, object: Entity = "object", minimal_height: float) -> Tensor:
    """1 where an object is higher than `minimal_height` [m] above its environment's origin. (num_envs,)"""
    return object.data.root_pos_w[:, 2] - env.origins[:, 2] > minimal_height


def object_ee_distance(
    env: ManagedEnv, *, entity: Entity = "robot", sites: Sites, object: Entity = "object", std: float
) -> Tensor:
    """1 - tanh(distance / std) from a site of `entity` to an object; std [m]. (num_envs,)"""
    return _near(length(object.data.root_pos_w - only(entity.data.site_pos_w[:, sites], "site")), std)


def object_goal_distance(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    object: Entity = "object",
    command: Command,
    std: float,
    minimal_height: float,
) -> Tensor:
    """1 - tanh(distance / std) from an object to the goal of a pose command, once lifted; std [m]. (num_envs,)"""
    distance = length(goal_in_world(entity, command) - object.data.root_pos_w)
    return _near(distance, std) * (object.data.root_pos_w[:, 2] - env.origins[:, 2] > minimal_height)


def success_bonus(env: ManagedEnv, *, object: Entity = "object", command: Command, threshold: float = 0.1) -> Tensor:
    """1 where an object's attitude is within `threshold` [rad] of the goal's. (num_envs,)

    The goal is columns 3 to 6 of the command, in the world frame.
    """
    return turn_between(object.data.root_quat_w, command.command[:, 3:7]) <= threshold


def track_pos_l2(env: ManagedEnv, *, object: Entity = "object", command: Command) -> Tensor:
    """Distance from an object to the goal, columns 0 to 2 of a command in its environment's frame [m]. (num_envs,)"""
    return length(command.command[:, :3] + env.origins - object.data.root_pos_w)


def track_orientation_inv_l2(
    env: ManagedEnv, *, object: Entity = "object", command: Command, rot_eps: float = 1e-3
) -> Tensor:
    """1 / (angle + rot_eps) between an object's attitude and the goal's, world frame [1/rad]. (num_envs,)"""
    return 1.0 / (turn_between(object.data.root_quat_w, command.command[:, 3:7]) + rot_eps)


class _Handle:
    """Terms of a site of `entity` and a site, `handle`, of another entity."""

    def __init__(self, entity: Entity, sites: Sites, cabinet: Entity, handle: str) -> None:
        self._entity, self._sites = entity, sites
        self._cabinet, self._handle = cabinet, cabinet.select("Sites", handle)[0]

    def _distance(self) -> Tensor:
        handle = only(self._cabinet.data.site_pos_w[:, self._handle], "handle")
        return length(handle - only(self._entity.data.site_pos_w[:, self._sites], "site"))


class ApproachEeHandle(_Handle):
    """(1 / (1 + distance^2))^2 from a site to a handle, doubled where it is within `threshold` [m]. (num_envs,)"""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        sites: Sites,
        cabinet: Entity = "cabinet",
        handle: str,
        threshold: float,
    ) -> None:
        super().__init__(entity, sites, cabinet, handle)
        self._threshold = threshold

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        distance = self._distance()
        near = (1.0 / (1.0 + distance.square())).square_()
        return torch.where(distance <= self._threshold, 2.0 * near, near)


class AlignEeHandle(_Handle):
    """How well a site's z axis points against a handle's x axis, and its x axis against its y axis. (num_envs,)

    (sign(a) a^2 + sign(b) b^2) / 2 of the two cosines: 1 aligned.
    """

    def __init__(
        self, env: ManagedEnv, *, entity: Entity = "robot", sites: Sites, cabinet: Entity = "cabinet", handle: str
    ) -> None:
        super().__init__(entity, sites, cabinet, handle)

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        site = only(self._entity.data.site_quat_w[:, self._sites], "site")
        handle = only(self._cabinet.data.site_quat_w[:, self._handle], "handle")
        grip = -(axis_z(site) * axis_x(handle)).sum(dim=1)
        turn = -(axis_x(site) * axis_y(handle)).sum(dim=1)
        return 0.5 * (grip.sign() * grip.square() + turn.sign() * turn.square())


class GraspHandle(_Handle):
    """How far `joints`, the fingers, are closed where a site is within `threshold` [m] of a handle [m]. (num_envs,)

    The sum of open_joint_pos - position.
    """

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        sites: Sites,
        joints: Joints,
        cabinet: Entity = "cabinet",
        handle: str,
        threshold: float,
        open_joint_pos: float,
    ) -> None:
        super().__init__(entity, sites, cabinet, handle)
        self._joints, self._threshold, self._open = joints, threshold, open_joint_pos

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        closed = (self._open - self._entity.data.joint_pos_of(self._joints)).sum(dim=1)
        return closed * (self._distance() <= self._threshold)


def open_drawer_bonus(env: ManagedEnv, *, entity: Entity = "cabinet", joints: Joints) -> Tensor:
    """How far joints of a cabinet are open, summed [m]. (num_envs,)  Isaac Lab: doubled while the handle is held."""
    return entity.data.joint_pos_of(joints).sum(dim=1)


def multi_stage_open_drawer(env: ManagedEnv, *, entity: Entity = "cabinet", joints: Joints) -> Tensor:
    """0.5 for a drawer open by 0.01 m, 1 more by 0.2 m, 1 more by 0.3 m. (num_envs,)

    Isaac Lab: the last two while the handle is held.
    """
    opening = only(entity.data.joint_pos_of(joints), "joint")
    return 0.5 * (opening > 0.01) + (opening > 0.2) + (opening > 0.3)


def _bell(squared: Tensor, std: float) -> Tensor:
    return torch.exp(-squared / (std * std))


def _near(distance: Tensor, std: float) -> Tensor:
    return 1.0 - torch.tanh(distance / std)


def _off_default(entity: Entity, joints: Joints) -> Tensor:
    return entity.data.joint_pos_of(joints) - entity.data.default_joint_pos_of(joints)


def _on_the_move(entity: Entity, command: Command, velocity_threshold: float) -> Tensor:
    """Where something is asked for, or the root is faster than the threshold. (num_envs,) bool"""
    speed = length(entity.data.root_lin_vel_b[:, :2])
    return (length(command.command) > 0.0) | (speed > velocity_threshold)


def _spread(
    given: float | list[float] | Tensor, entity: Entity, joints: Joints, device: torch.device, what: str = "std"
) -> Tensor:
    """One value a joint. (k,) or (1,)"""
    count = len(entity.data.joint_vel_limits[joints])
    values = given if isinstance(given, Tensor) else torch.tensor(given, dtype=torch.float32, device=device)
    if values.dim() and len(values) != count:
        raise ValueError(f"has {len(values)} values of {what} for {count} joints")
    return values.view(-1)


def _xy(entity: Entity) -> Columns:
    return slice(entity.root_qpos, entity.root_qpos + 2)


def _dot_xy(left: Tensor, right: Tensor) -> Tensor:
    return left[:, 0] * right[:, 0] + left[:, 1] * right[:, 1]


def _norm_xy(vector: Tensor) -> Tensor:
    return (vector[:, 0].square() + vector[:, 1].square()).sqrt_()

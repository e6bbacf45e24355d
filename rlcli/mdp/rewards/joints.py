"""Reward terms of joints: positions, velocities, efforts, power and changes of the action. (num_envs,) each."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rlcli.mdp.parameter_types import Command, Entity, ManagedEnv
from rlcli.mdp.term import JointTerm, Term
from rlcli.mdp.term_helpers import commanded_speed, is_moving, sum_columns
from rlcli.sim.env_selection import Selection
from rlcli.sim.rotations import length
from rlcli.sim.saved_tensors import TensorState
from rlcli.task import Joints


def joint_pos_target_l2(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", target: float) -> Tensor:
    """Sum of the squared deviations of joints from `target` [rad^2], positions wrapped to [-pi, pi]. (num_envs,)"""
    angle = entity.data.joint_angle_of(joints)
    deviation = angle - target if isinstance(target, Tensor) or target else angle
    return sum_columns(deviation.square())


def joint_vel_l1(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of the absolute joint velocities [rad/s or m/s]. (num_envs,)"""
    return sum_columns(entity.data.joint_vel_of(joints).abs())


def joint_vel_l2(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of the squared joint velocities [rad^2/s^2 or m^2/s^2]. (num_envs,)"""
    return sum_columns(entity.data.joint_vel_of(joints).square())


def joint_acc_l2(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of the squared joint accelerations in the last substep [rad^2/s^4]. (num_envs,)"""
    return sum_columns(entity.data.joint_acc[:, joints].square())


def joint_torques_l2(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of the squared actuator efforts on the joints, after their limits [N^2 m^2]. (num_envs,)"""
    return sum_columns(entity.data.applied_effort[:, joints].square())


def joint_pos_limits(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of the distances of joints beyond their soft limits [rad]. (num_envs,)"""
    position = entity.data.joint_pos_of(joints)
    low, high = entity.data.joint_limits_of(joints, soft=True)
    return ((low - position).clamp_(min=0.0) + (position - high).clamp_(min=0.0)).sum(dim=1)


@dataclass(kw_only=True, eq=False)
class JointPosLimitsPenaltyRatio(JointTerm):
    """Sum over joints of a value that rises from 0 at `threshold` to the gear ratio at the soft limit. (num_envs,)

    A joint position is scaled to x: -1 at the lower and 1 at the upper soft limit (at the joint's own limits if
    `soft_joint_pos_limit_factor` is above 1). The value of a joint is (|x| - threshold) / (1 - threshold) x gear_ratio
    if |x| > threshold, otherwise 0; 0 also for a joint without limits.

    gear_ratio: one number for all joints, or one number for each joint in the order of `joints`.
    """

    threshold: float = 0.98
    gear_ratio: float | list[float] = 1.0

    def __post_init__(self) -> None:
        self._ratio = _per_joint(self, self.gear_ratio, "gear_ratio")

    def __call__(self) -> Tensor:
        """Return the value of the reward term. (num_envs,)"""
        data, soft = self.entity.data, self.entity.config.soft_joint_pos_limit_factor < 1.0
        low, high = (limit[:, self.joints] for limit in data.joint_limits(soft))  # at 1.0 soft limits are the limits
        scaled = ((2.0 * data.joint_pos_of(self.joints) - low - high) / (high - low)).abs()
        violation = (scaled - self.threshold) / (1.0 - self.threshold)
        # a joint without limits has no scale (nan), and is never beyond it
        return torch.where(scaled > self.threshold, violation * self._ratio, 0.0).sum(dim=1)


def joints_at_limit(
    env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", threshold: float = 0.99
) -> Tensor:
    """Count the joints beyond +-`threshold`, in positions that are scaled to +-1 at the soft limits. (num_envs,)

    Joints without limits do not count.
    """
    low, high = entity.data.joint_limits_of(joints, soft=True)
    scaled = (2.0 * entity.data.joint_pos_of(joints) - low - high) / (high - low)
    return (scaled.abs_() > threshold).sum(dim=1).float()


@dataclass(kw_only=True, eq=False)
class PowerConsumption(JointTerm):
    """Sum of |policy's action x joint velocity x gear ratio| over joints [rad/s]. (num_envs,)

    joints: the joints that the action drives, in its order. gear_ratio: one for all joints, or one for each.
    """

    gear_ratio: float | list[float] = 1.0

    def __post_init__(self) -> None:
        self._ratio = _per_joint(self, self.gear_ratio, "gear_ratio")

    def __call__(self) -> Tensor:
        """Return the value of the reward term. (num_envs,)"""
        action, velocity = self.env.action_manager.action, self.entity.data.joint_vel_of(self.joints)
        if action.shape != velocity.shape:
            found, wanted = velocity.shape[1], action.shape[1]
            raise ValueError(f"`joints` selects {found} joints; select {wanted}, one for each column of the action")
        power: Tensor = (action * velocity * self._ratio).abs().sum(dim=1)
        return power


def action_rate_l2(env: ManagedEnv) -> Tensor:
    """Sum of the squared changes of the policy's action since the last step. (num_envs,)"""
    return (env.action_manager.action - env.action_manager.prev_action).square_().sum(dim=1)


def action_l2(env: ManagedEnv) -> Tensor:
    """Sum of the squares of the policy's action. (num_envs,)"""
    return env.action_manager.action.square().sum(dim=1)


@dataclass(eq=False)
class ActionAccL2(Term, TensorState):
    """Sum of the squared second differences a - 2 a' + a'' of the policy's action. (num_envs,)

    a: action of this step, a': of the step before, a'': of the step before that; zero before the episode.
    mjlab: `action_acc_l2`.
    """

    def __post_init__(self) -> None:
        self._before = torch.zeros_like(self.env.action_manager.action)

    def __call__(self) -> Tensor:
        """Return the value of the reward term. (num_envs,)"""
        action, previous = self.env.action_manager.action, self.env.action_manager.prev_action
        change = action - 2.0 * previous + self._before
        self._before.copy_(previous)
        return change.square_().sum(dim=1)

    def reset(self, selection: Selection) -> None:
        """Set the past actions to 0 in new episodes."""
        selection.write(self._before, 0.0)

    def tensors(self) -> dict[str, Tensor]:
        """Return the action that is a'' in the next step."""
        return {"before": self._before}


def action_smoothness_penalty(env: ManagedEnv) -> Tensor:
    """Norm of the change of the policy's action since the last step. (num_envs,)"""
    return length(env.action_manager.action - env.action_manager.prev_action)


def joint_deviation_l1(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of the absolute deviations of joints from their default positions [rad]. (num_envs,)"""
    return _deviation(entity, joints).abs().sum(dim=1)


def stand_still_joint_deviation_l1(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    joints: Joints = ".*",
    command: Command,
    command_threshold: float = 0.06,
) -> Tensor:
    """`joint_deviation_l1` [rad] where the commanded speed is below `command_threshold` [m/s]. (num_envs,)"""
    return _deviation(entity, joints).abs().sum(dim=1) * (commanded_speed(command) < command_threshold)


def joint_vel_limits(
    env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", soft_ratio: float = 1.0
) -> Tensor:
    """Sum of max(speed - `soft_ratio` x `velocity_limit`, 0) over joints, each at most 1 [m/s or rad/s]. (num_envs,)"""
    excess = entity.data.joint_vel_of(joints).abs() - entity.data.joint_vel_limits[joints] * soft_ratio
    return excess.clamp_(0.0, 1.0).sum(dim=1)


def joint_velocity_hinge_penalty(
    env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", max_velocity: float
) -> Tensor:
    """Sum of the squared excess of joint speeds over `max_velocity` [rad^2/s^2]. (num_envs,)

    max_velocity [rad/s]. mjlab: `joint_velocity_hinge_penalty`.
    """
    return (entity.data.joint_vel_of(joints).abs() - max_velocity).clamp_(min=0.0).square_().sum(dim=1)


def applied_torque_limits(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum over joints of the magnitude by which limits reduce the actuators' effort [N or N m]. (num_envs,)

    The efforts of MuJoCo's own actuators follow from the present state and controls. Isaac Lab: explicit actuators
    only, with values of the last substep.
    """
    return entity.data.withheld_effort[:, joints].sum(dim=1)


def electrical_power_cost(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of the positive mechanical power of actuators; braking power does not count [W]. (num_envs,)

    mjlab: `electrical_power_cost`.
    """
    power = entity.data.applied_effort[:, joints] * entity.data.joint_vel_of(joints)
    return power.clamp_(min=0.0).sum(dim=1)


def joint_acceleration_penalty(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Norm of the joint accelerations in the last substep [rad/s^2]. (num_envs,)"""
    return length(entity.data.joint_acc[:, joints])


def joint_torques_penalty(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Norm of the actuator efforts on the joints, after their limits [N m]. (num_envs,)"""
    return length(entity.data.applied_effort[:, joints])


def joint_velocity_penalty(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Norm of the joint velocities [rad/s]. (num_envs,)"""
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
    """Norm of the deviations of joints from their defaults, times `stand_still_scale` while standing [rad]. (num_envs,)

    Standing: the command is zero, and the root is slower than `velocity_threshold` [m/s].
    """
    deviation = length(_deviation(entity, joints))
    return torch.where(is_moving(entity, command, velocity_threshold), deviation, stand_still_scale * deviation)


@dataclass(kw_only=True, eq=False)
class Posture(JointTerm):
    """exp(-mean of (deviation from default / std)^2) over the joints. (num_envs,)  mjlab: `posture`.

    std: tolerated deviation [rad], one for all joints or one for each in the order of `joints`.
    """

    std: float | list[float]

    def __post_init__(self) -> None:
        self._std = _per_joint(self, self.std)

    def __call__(self) -> Tensor:
        """Return the value of the reward term. (num_envs,)"""
        return (_deviation(self.entity, self.joints) / self._std).square_().mean(dim=1).neg_().exp_()


@dataclass(kw_only=True, eq=False)
class VariablePosture(JointTerm):
    """`posture` with different `std` for standing, walking and running. (num_envs,)  mjlab: `variable_posture`.

    The commanded speed decides: the horizontal speed [m/s] plus the yaw rate [rad/s] of a velocity command. Below
    `walking_threshold` the robot stands, from `running_threshold` on it runs. The std values are as in `posture` [rad].
    """

    command: Command
    std_standing: float | list[float]
    std_walking: float | list[float]
    std_running: float | list[float]
    walking_threshold: float = 0.5
    running_threshold: float = 1.5

    def __post_init__(self) -> None:
        stds = (self.std_standing, self.std_walking, self.std_running)
        self._standing, self._walking, self._running = (_per_joint(self, std) for std in stds)

    def __call__(self) -> Tensor:
        """Return the value of the reward term. (num_envs,)"""
        speed = (commanded_speed(self.command) + self.command.command[:, 2].abs())[:, None]
        std = torch.where(speed < self.walking_threshold, self._standing, self._walking)
        std = torch.where(speed < self.running_threshold, std, self._running)
        return (_deviation(self.entity, self.joints) / std).square_().mean(dim=1).neg_().exp_()


def _deviation(entity: Entity, joints: Joints) -> Tensor:
    return entity.data.joint_pos_of(joints) - entity.data.default_joint_pos_of(joints)


def _per_joint(term: JointTerm, value: float | list[float] | Tensor, key: str = "std") -> Tensor:
    """Return a setting as a tensor: one value for all joints, or one for each. (1,) or (k,)

    Raises:
        ValueError: for another number of values than joints.
    """
    count = len(term.entity.data.joint_vel_limits[term.joints])
    values = value if isinstance(value, Tensor) else torch.tensor(value, dtype=torch.float32, device=term.env.device)
    if values.dim() and len(values) != count:
        raise ValueError(f"{key} has {len(values)} values; give one number, or a list of {count} (one per joint)")
    return values.view(-1)

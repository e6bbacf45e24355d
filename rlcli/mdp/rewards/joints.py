"""Reward terms of joints: positions, velocities, efforts, power and changes of the action. (num_envs,) each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rlcli.mdp.parameters import Command, Entity
from rlcli.mdp.term import JointTerm
from rlcli.mdp.term_helpers import asked_speed, is_moving, total
from rlcli.sim.rotations import length
from rlcli.sim.selection import Selection
from rlcli.task import Joints

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv


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


@dataclass(kw_only=True, eq=False)
class JointPosLimitsPenaltyRatio(JointTerm):
    """How far beyond `threshold` of their range joints are, as a share of what is left of it, summed. (num_envs,)

    gear_ratio: what each joint counts, one for all or one each, in the order of `joints`.
    """

    threshold: float = 0.98
    gear_ratio: float | list[float] = 1.0

    def __post_init__(self) -> None:
        self._ratio = _spread(self.gear_ratio, self.entity, self.joints, self.env.device, "gear_ratio")

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        low, high = (limit[:, self.joints] for limit in self.entity.data.joint_limits())
        scaled = ((2.0 * self.entity.data.joint_pos_of(self.joints) - low - high) / (high - low)).abs()
        violation = (scaled - self.threshold) / (1.0 - self.threshold)
        # a joint without limits has no scale (nan), and is never beyond it
        return torch.where(scaled > self.threshold, violation * self._ratio, 0.0).sum(dim=1)


def joints_at_limit(
    env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", threshold: float = 0.99
) -> Tensor:
    """How many joints are beyond `threshold` of their range, -1 and 1 at the soft limits. (num_envs,)

    A joint without limits never is.
    """
    low, high = entity.data.joint_limits_of(joints, soft=True)
    scaled = (2.0 * entity.data.joint_pos_of(joints) - low - high) / (high - low)
    return (scaled.abs_() > threshold).sum(dim=1).float()


@dataclass(kw_only=True, eq=False)
class PowerConsumption(JointTerm):
    """Sum of |raw action x joint velocity x gear ratio|; `joints` are the driven ones, in the action's order [rad/s].

    gear_ratio: one for all or one each, in the order of `joints`. (num_envs,)
    """

    gear_ratio: float | list[float] = 1.0

    def __post_init__(self) -> None:
        self._ratio = _spread(self.gear_ratio, self.entity, self.joints, self.env.device, "gear_ratio")

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        action, velocity = self.env.action_manager.action, self.entity.data.joint_vel_of(self.joints)
        if action.shape != velocity.shape:
            raise ValueError(f"selects {velocity.shape[1]} joints, the action has {action.shape[1]} columns")
        power: Tensor = (action * velocity * self._ratio).abs().sum(dim=1)
        return power


def action_rate_l2(env: ManagedEnv) -> Tensor:
    """Sum of squared changes of the policy's action. (num_envs,)"""
    return (env.action_manager.action - env.action_manager.prev_action).square_().sum(dim=1)


def action_l2(env: ManagedEnv) -> Tensor:
    """Sum of squares of the policy's action. (num_envs,)"""
    return env.action_manager.action.square().sum(dim=1)


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
    return torch.where(is_moving(entity, command, velocity_threshold), deviation, stand_still_scale * deviation)


@dataclass(kw_only=True, eq=False)
class Posture(JointTerm):
    """exp(-mean of (deviation from default / std)^2) over the joints. (num_envs,)  mjlab: `posture`.

    std: how far joints may be off [rad], one for all or one each, in the order of `joints`.
    """

    std: float | list[float]

    def __post_init__(self) -> None:
        self._std = _spread(self.std, self.entity, self.joints, self.env.device)

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        return (_off_default(self.entity, self.joints) / self._std).square_().mean(dim=1).neg_().exp_()


@dataclass(kw_only=True, eq=False)
class VariablePosture(JointTerm):
    """`posture` with another `std` at a stand, at a walk and at a run. (num_envs,)  mjlab: `variable_posture`.

    By the speed that a velocity command asks for, in the plane [m/s] and about the vertical [rad/s] added up: below
    `walking_threshold` at a stand, from `running_threshold` on at a run.
    """

    command: Command
    std_standing: float | list[float]
    std_walking: float | list[float]
    std_running: float | list[float]
    walking_threshold: float = 0.5
    running_threshold: float = 1.5

    def __post_init__(self) -> None:
        stds = (self.std_standing, self.std_walking, self.std_running)
        self._standing, self._walking, self._running = (
            _spread(std, self.entity, self.joints, self.env.device) for std in stds
        )

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        speed = (asked_speed(self.command) + self.command.command[:, 2].abs())[:, None]
        std = torch.where(speed < self.walking_threshold, self._standing, self._walking)
        std = torch.where(speed < self.running_threshold, std, self._running)
        return (_off_default(self.entity, self.joints) / std).square_().mean(dim=1).neg_().exp_()


def _off_default(entity: Entity, joints: Joints) -> Tensor:
    return entity.data.joint_pos_of(joints) - entity.data.default_joint_pos_of(joints)


def _spread(
    given: float | list[float] | Tensor, entity: Entity, joints: Joints, device: torch.device, what: str = "std"
) -> Tensor:
    """One value a joint. (k,) or (1,)"""
    count = len(entity.data.joint_vel_limits[joints])
    values = given if isinstance(given, Tensor) else torch.tensor(given, dtype=torch.float32, device=device)
    if values.dim() and len(values) != count:
        raise ValueError(f"has {len(values)} values of {what} for {count} joints")
    return values.view(-1)

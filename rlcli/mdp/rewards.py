"""Reward terms, unsigned and unweighted: the YAML's `weight` gives sign and size. (num_envs,) each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rlcli.sim.rotations import rotate, wrap_to_pi
from rlcli.sim.selection import Columns, Selection
from rlcli.task import Entity, Joints

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
    deviation = wrap_to_pi(entity.data.joint_pos[:, joints]) - target
    return deviation.square_().sum(dim=1)


def joint_vel_l1(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of absolute joint velocities [rad/s]. (num_envs,)"""
    return entity.data.joint_vel[:, joints].abs().sum(dim=1)


def joint_vel_l2(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of squared joint velocities [rad^2/s^2]. (num_envs,)"""
    return entity.data.joint_vel[:, joints].square().sum(dim=1)


def joint_acc_l2(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of squared joint accelerations over the last substep [rad^2/s^4]. (num_envs,)"""
    return entity.data.joint_acc[:, joints].square().sum(dim=1)


def joint_torques_l2(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Sum of squared actuator efforts on the joints, after their limits [N^2 m^2]. (num_envs,)"""
    return entity.data.applied_effort[:, joints].square().sum(dim=1)


def joint_pos_limits(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """How far joints are outside their soft limits, summed [rad]. (num_envs,)"""
    position = entity.data.joint_pos[:, joints]
    low, high = (limit[:, joints] for limit in entity.data.joint_limits(soft=True))
    return ((low - position).clamp_(min=0.0) + (position - high).clamp_(min=0.0)).sum(dim=1)


def joint_pos_limits_penalty_ratio(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    joints: Joints = ".*",
    threshold: float = 0.98,
    gear_ratio: float = 1.0,
) -> Tensor:
    """How far beyond `threshold` of their range joints are, as a share of what is left of it, summed. (num_envs,)"""
    low, high = (limit[:, joints] for limit in entity.data.joint_limits())
    scaled = ((2.0 * entity.data.joint_pos[:, joints] - low - high) / (high - low)).abs()
    violation = (scaled - threshold) / (1.0 - threshold)
    # a joint without limits has no scale (nan), and is never beyond it
    return torch.where(scaled > threshold, violation * gear_ratio, 0.0).sum(dim=1)


def power_consumption(
    env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", gear_ratio: float = 1.0
) -> Tensor:
    """Sum of |raw action x joint velocity x gear ratio|; `joints` are the driven ones, in the action's order [rad/s].

    (num_envs,)
    """
    action, velocity = env.action_manager.action, entity.data.joint_vel[:, joints]
    if action.shape != velocity.shape:
        raise ValueError(f"selects {velocity.shape[1]} joints, the action has {action.shape[1]} columns")
    return (action * velocity * gear_ratio).abs().sum(dim=1)


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
    to_target = torch.tensor(target, device=env.device) - entity.data.root_pos_w
    forward = rotate(entity.data.root_quat_w, torch.tensor([1.0, 0.0, 0.0], device=env.device).expand(env.num_envs, 3))
    heading = (forward[:, 0] * to_target[:, 0] + forward[:, 1] * to_target[:, 1]) / _norm_xy(to_target).clamp_(min=1e-9)
    return torch.where(heading > threshold, 1.0, heading / threshold)


class ProgressReward:
    """Speed at which the root comes nearer to `target`, horizontally [m/s]. (num_envs,)"""

    def __init__(self, env: ManagedEnv, *, entity: Entity = "robot", target: tuple[float, float, float]) -> None:
        self._entity, self._dt = entity, env.step_dt
        self._target = torch.tensor(target, device=env.device)
        self._potential = self._measure()

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        before, self._potential = self._potential, self._measure()
        return self._potential - before

    def reset(self, selection: Selection) -> None:
        """The first step of an episode compares with its start state, which is set by now."""
        position = selection.read(self._entity.engine.field("qpos"), _xyz(self._entity)).float()
        selection.write(self._potential, -_norm_xy(self._target - position) / self._dt)

    def state_dict(self) -> dict[str, Tensor]:
        """The potential of the last step."""
        return {"potential": self._potential.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take back what `state_dict` gave."""
        self._potential = state["potential"].clone()

    def _measure(self) -> Tensor:
        return -_norm_xy(self._target - self._entity.data.root_pos_w) / self._dt


def _xyz(entity: Entity) -> Columns:
    return slice(entity.root_qpos, entity.root_qpos + 3)


def _norm_xy(vector: Tensor) -> Tensor:
    return (vector[:, 0].square() + vector[:, 1].square()).sqrt_()

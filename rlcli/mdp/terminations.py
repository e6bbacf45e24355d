"""Termination terms. (num_envs,) bool each."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from torch import Tensor

from rlcli.task import Entity, Joints, Range

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv


def time_out(env: ManagedEnv) -> Tensor:
    """The episode has lasted `episode_length_s`. Declare it with `time_out: true`. (num_envs,)"""
    return env.episode_length_buf >= env.max_episode_length


def joint_pos_out_of_manual_limit(
    env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", bounds: Range
) -> Tensor:
    """Some joint is outside `bounds` [m or rad]. (num_envs,)"""
    position = entity.data.joint_pos[:, joints]
    return ((position < bounds[0]) | (position > bounds[1])).any(dim=1)


def joint_pos_out_of_limit(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Some joint is outside its soft limits. (num_envs,)"""
    position = entity.data.joint_pos[:, joints]
    low, high = (limit[:, joints] for limit in entity.data.joint_limits(soft=True))
    return ((position < low) | (position > high)).any(dim=1)


def joint_vel_out_of_manual_limit(
    env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", max_velocity: float
) -> Tensor:
    """Some joint moves faster than `max_velocity` [m/s or rad/s]. (num_envs,)"""
    return (entity.data.joint_vel[:, joints].abs() > max_velocity).any(dim=1)


def bad_orientation(env: ManagedEnv, *, entity: Entity = "robot", limit_angle: float) -> Tensor:
    """The root's up axis is more than `limit_angle` [rad] from the world's. (num_envs,)

    The cosines are compared, so that rounding past 1 cannot hide a fall.
    """
    return -entity.data.projected_gravity_b[:, 2] < math.cos(limit_angle)


def root_height_below_minimum(env: ManagedEnv, *, entity: Entity = "robot", minimum_height: float) -> Tensor:
    """The root is lower than `minimum_height` [m]. (num_envs,)"""
    return entity.data.root_pos_w[:, 2] < minimum_height

"""Termination terms. (num_envs,) bool each."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rlcli.mdp.parameters import Command, ContactSensor, Entity
from rlcli.mdp.term_helpers import cosine, goal_in_world, some, strongest_force
from rlcli.sim.rotations import length
from rlcli.task import Joints, Range

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv


def time_out(env: ManagedEnv) -> Tensor:
    """The episode has lasted `episode_length_s`. Declare it with `time_out: true`. (num_envs,)"""
    return env.episode_length_buf >= env.max_episode_length


def joint_pos_out_of_manual_limit(
    env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", bounds: Range
) -> Tensor:
    """Some joint is outside `bounds` [m or rad]. (num_envs,)"""
    position = entity.data.joint_pos_of(joints)
    return some((position < bounds[0]) | (position > bounds[1]))


def joint_pos_out_of_limit(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Some joint is outside its soft limits. (num_envs,)"""
    position = entity.data.joint_pos_of(joints)
    low, high = entity.data.joint_limits_of(joints, soft=True)
    return some((position < low) | (position > high))


def joint_vel_out_of_manual_limit(
    env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", max_velocity: float
) -> Tensor:
    """Some joint moves faster than `max_velocity` [m/s or rad/s]. (num_envs,)"""
    return some(entity.data.joint_vel_of(joints).abs() > max_velocity)


def bad_orientation(env: ManagedEnv, *, entity: Entity = "robot", limit_angle: float) -> Tensor:
    """The root's up axis is more than `limit_angle` [rad] from the world's. (num_envs,)

    The cosines are compared, so that rounding past 1 cannot hide a fall.
    """
    return -entity.data.projected_gravity_b[:, 2] < cosine(limit_angle)


def root_height_below_minimum(env: ManagedEnv, *, entity: Entity = "robot", minimum_height: float) -> Tensor:
    """The root is lower than `minimum_height` above its environment's origin [m]. (num_envs,)"""
    return entity.data.root_pos_w[:, 2] - env.origins[:, 2] < minimum_height


def joint_vel_out_of_limit(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Some joint moves faster than its `velocity_limit`. (num_envs,)"""
    return some(entity.data.joint_vel_of(joints).abs() > entity.data.joint_vel_limits[joints])


def joint_effort_out_of_limit(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Some actuator was to give more than it can. (num_envs,)

    MuJoCo's own actuators by the present state and controls. Isaac Lab: explicit actuators only, of the last substep.
    """
    return some(entity.data.withheld_effort[:, joints] > 0.0)


def illegal_contact(env: ManagedEnv, *, sensor: ContactSensor, threshold: float = 1.0) -> Tensor:
    """Some body of the sensor has felt a contact force above `threshold` [N], within its history. (num_envs,)"""
    return some(strongest_force(sensor) > threshold)


def out_of_bound(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    x: Range | None = None,
    y: Range | None = None,
    z: Range | None = None,
) -> Tensor:
    """The root is outside a box about its environment's origin [m]; no range, no bounds. (num_envs,)"""
    outside = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
    place = entity.data.root_pos_w - env.origins
    for column, bounds in enumerate((x, y, z)):
        if bounds is not None:
            outside |= (place[:, column] < bounds[0]) | (place[:, column] > bounds[1])
    return outside


def abnormal_robot_state(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """Some joint moves faster than twice its `velocity_limit`. (num_envs,)"""
    return some(entity.data.joint_vel_of(joints).abs() > 2.0 * entity.data.joint_vel_limits[joints])


def object_reached_goal(
    env: ManagedEnv, *, entity: Entity = "robot", object: Entity = "object", command: Command, threshold: float = 0.02
) -> Tensor:
    """An object is within `threshold` of the goal of a pose command of `entity` [m]. (num_envs,)"""
    return length(goal_in_world(entity, command) - object.data.root_pos_w) < threshold


def object_away_from_goal(
    env: ManagedEnv, *, entity: Entity = "robot", object: Entity = "object", command: Command, threshold: float
) -> Tensor:
    """An object is further than `threshold` from the goal of a pose command of `entity` [m]. (num_envs,)"""
    return length(goal_in_world(entity, command) - object.data.root_pos_w) > threshold


def object_away_from_robot(
    env: ManagedEnv, *, entity: Entity = "robot", object: Entity = "object", threshold: float
) -> Tensor:
    """An object is further than `threshold` from the root of `entity` [m]. (num_envs,)"""
    return length(entity.data.root_pos_w - object.data.root_pos_w) > threshold

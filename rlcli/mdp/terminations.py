"""Termination terms. Each returns the environments whose episode ends, (num_envs,) bool."""

from __future__ import annotations

import torch
from torch import Tensor

from rlcli.mdp.parameter_types import Command, ContactSensor, Entity, ManagedEnv
from rlcli.mdp.term_helpers import any_column, cosine, goal_in_world, strongest_force
from rlcli.sim.rotations import length
from rlcli.task import Joints, Range


def time_out(env: ManagedEnv) -> Tensor:
    """End the episode when it has lasted `episode_length_s`. (num_envs,)

    Declare the term with `time_out: true`, so that the episode is truncated, not terminated.
    """
    return env.episode_length_buf >= env.max_episode_length


def joint_pos_out_of_manual_limit(
    env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", bounds: Range
) -> Tensor:
    """End the episode if any joint is outside `bounds` [m or rad]. (num_envs,)"""
    position = entity.data.joint_pos_of(joints)
    return any_column((position < bounds[0]) | (position > bounds[1]))


def joint_pos_out_of_limit(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """End the episode if any joint is outside its soft limits. (num_envs,)"""
    position = entity.data.joint_pos_of(joints)
    low, high = entity.data.joint_limits_of(joints, soft=True)
    return any_column((position < low) | (position > high))


def joint_vel_out_of_manual_limit(
    env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*", max_velocity: float
) -> Tensor:
    """End the episode if any joint is faster than `max_velocity` [m/s or rad/s]. (num_envs,)"""
    return any_column(entity.data.joint_vel_of(joints).abs() > max_velocity)


def bad_orientation(env: ManagedEnv, *, entity: Entity = "robot", limit_angle: float) -> Tensor:
    """End the episode if the root's up axis is more than `limit_angle` [rad] from the world's. (num_envs,)

    The term compares cosines: `acos` of a cosine above 1, a rounding error, would be nan and hide a fall.
    """
    return -entity.data.projected_gravity_b[:, 2] < cosine(limit_angle)


def root_height_below_minimum(env: ManagedEnv, *, entity: Entity = "robot", minimum_height: float) -> Tensor:
    """End the episode if the root is under `minimum_height` [m] above its environment's origin. (num_envs,)"""
    return entity.data.root_pos_w[:, 2] - env.origins[:, 2] < minimum_height


def joint_vel_out_of_limit(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """End the episode if any joint is faster than its `velocity_limit`. (num_envs,)"""
    return any_column(entity.data.joint_vel_of(joints).abs() > entity.data.joint_vel_limits[joints])


def joint_effort_out_of_limit(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """End the episode if the effort of any actuator, before it is clipped, exceeds the effort limit. (num_envs,)

    For MuJoCo's own actuators, this effort is computed from the present state and controls. Isaac Lab checks actuator
    models only (its explicit actuators), with values of the last physics step.
    """
    return any_column(entity.data.withheld_effort[:, joints] > 0.0)


def illegal_contact(env: ManagedEnv, *, sensor: ContactSensor, threshold: float = 1.0) -> Tensor:
    """End the episode if any body of the sensor has a force above `threshold` [N]. (num_envs,)

    The force is the largest within the history of the sensor.
    """
    return any_column(strongest_force(sensor) > threshold)


def out_of_bound(
    env: ManagedEnv, *, entity: Entity = "robot", x: Range | None = None, y: Range | None = None, z: Range | None = None
) -> Tensor:
    """End the episode if the root is outside the ranges x, y, z from its environment's origin [m]. (num_envs,)

    An axis without a range is not checked.
    """
    outside = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)
    position = entity.data.root_pos_w - env.origins
    for column, bounds in enumerate((x, y, z)):
        if bounds is not None:
            outside |= (position[:, column] < bounds[0]) | (position[:, column] > bounds[1])
    return outside


def abnormal_robot_state(env: ManagedEnv, *, entity: Entity = "robot", joints: Joints = ".*") -> Tensor:
    """End the episode if any joint is faster than twice its `velocity_limit`. (num_envs,)"""
    return any_column(entity.data.joint_vel_of(joints).abs() > 2.0 * entity.data.joint_vel_limits[joints])


def object_reached_goal(
    env: ManagedEnv, *, entity: Entity = "robot", object: Entity = "object", command: Command, threshold: float = 0.02
) -> Tensor:
    """End the episode if an object is within `threshold` [m] of the goal of a pose command. (num_envs,)

    The command gives the goal in the frame of the root of `entity`.
    """
    return length(goal_in_world(entity, command) - object.data.root_pos_w) < threshold


def object_away_from_goal(env: ManagedEnv, *, object: Entity = "object", command: Command, threshold: float) -> Tensor:
    """End the episode if an object is over `threshold` [m] from the goal. (num_envs,)

    The goal is in columns 0 to 2 of the command, from the environment's origin.
    """
    return length(command.command[:, :3] + env.origins - object.data.root_pos_w) > threshold


def object_away_from_robot(
    env: ManagedEnv, *, entity: Entity = "robot", object: Entity = "object", threshold: float
) -> Tensor:
    """End the episode if an object is more than `threshold` [m] from the root of `entity`. (num_envs,)"""
    return length(entity.data.root_pos_w - object.data.root_pos_w) > threshold

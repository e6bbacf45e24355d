"""Success conditions: true of the states that an episode should end in. (num_envs,) bool each."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from rlcli.mdp.parameters import Command, Entity
from rlcli.mdp.term_helpers import cosine, every, goal_in_world, goal_quat_in_world, only, vector
from rlcli.sim.rotations import length, turn_between, wrap_to_pi
from rlcli.task import Bodies, Joints, Sites

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv
    from rlcli.envs.vec_env import VecEnv


def joints_near(
    env: VecEnv, *, entity: Entity = "robot", joints: Joints = ".*", target: float = 0.0, tolerance: float
) -> Tensor:
    """Every joint is within `tolerance` of `target` [m or rad], the difference wrapped to [-pi, pi]. (num_envs,)"""
    data = entity.data
    angle = wrap_to_pi(data.joint_pos_of(joints) - target) if target else data.joint_angle_of(joints)
    return every(angle.abs() < tolerance)


def root_moves(
    env: VecEnv,
    *,
    entity: Entity = "robot",
    direction: tuple[float, float, float] = (1.0, 0.0, 0.0),
    speed: float,
    limit_angle: float | None = None,
) -> Tensor:
    """The root's velocity, projected on `direction` (world frame, of length 1), is above `speed` [m/s]. (num_envs,)

    With `limit_angle` its up axis must be within that of the way up too [rad].
    """
    x, y, z = entity.data.root_lin_vel_w.unbind(dim=1)
    moves = direction[0] * x + direction[1] * y + direction[2] * z > speed
    if limit_angle is None:
        return moves
    return moves & (-entity.data.projected_gravity_b[:, 2] > cosine(limit_angle))


def root_upright(
    env: VecEnv, *, entity: Entity = "robot", limit_angle: float, minimum_height: float | None = None
) -> Tensor:
    """The root's up axis is within `limit_angle` [rad] of the way up, and it is high enough [m]. (num_envs,)"""
    upright = -entity.data.projected_gravity_b[:, 2] > cosine(limit_angle)
    if minimum_height is None:
        return upright
    return upright & (entity.data.root_pos_w[:, 2] - env.origins[:, 2] > minimum_height)


def root_near(env: VecEnv, *, entity: Entity = "robot", target: tuple[float, float, float], tolerance: float) -> Tensor:
    """The root is within `tolerance` of `target`, a point from its environment's origin [m]. (num_envs,)"""
    return length(entity.data.root_pos_w - env.origins - vector(target, env.device)) < tolerance


def root_hovers(
    env: VecEnv, *, entity: Entity = "robot", goal: Entity = "target", tolerance: float, speed: float
) -> Tensor:
    """The root is within `tolerance` [m] of the root of `goal`, and slower than `speed` [m/s]. (num_envs,)"""
    near = length(entity.data.root_pos_w - goal.data.root_pos_w) < tolerance
    return near & (length(entity.data.root_lin_vel_w) < speed)


def velocity_tracked(
    env: VecEnv,
    *,
    entity: Entity = "robot",
    command: Command,
    linear_tolerance: float,
    angular_tolerance: float,
) -> Tensor:
    """The root follows a velocity command to within [m/s] in the plane and [rad/s] about its up axis. (num_envs,)"""
    data, asked = entity.data, command.command
    linear = length(asked[:, :2] - data.root_lin_vel_b[:, :2]) < linear_tolerance
    return linear & ((asked[:, 2] - data.root_ang_vel_b[:, 2]).abs() < angular_tolerance)


def velocity_tracked_on_average(
    env: ManagedEnv, *, command: Command, linear_tolerance: float, angular_tolerance: float
) -> Tensor:
    """The episode's mean errors of a velocity command are within these so far [m/s, rad/s]. (num_envs,)

    Its starts and its changes of command count, too.
    """
    so_far = env.command_manager.so_far
    linear = so_far(command, "error_vel_xy") < linear_tolerance
    return linear & (so_far(command, "error_vel_yaw") < angular_tolerance)


def body_at_goal(
    env: VecEnv,
    *,
    entity: Entity = "robot",
    bodies: Bodies,
    command: Command,
    tolerance: float,
    angle_tolerance: float | None = None,
) -> Tensor:
    """A body is within `tolerance` of the goal of a pose command of `entity` [m]. (num_envs,)

    With `angle_tolerance` its attitude also is, of the goal's [rad].
    """
    near = length(only(entity.data.body_pos_w[:, bodies], "body") - goal_in_world(entity, command)) < tolerance
    if angle_tolerance is None:
        return near
    attitude = only(entity.data.body_quat_w[:, bodies], "body").contiguous()
    return near & (turn_between(attitude, goal_quat_in_world(entity, command)) < angle_tolerance)


def site_at_goal(env: VecEnv, *, entity: Entity = "robot", sites: Sites, command: Command, tolerance: float) -> Tensor:
    """A site is within `tolerance` of the goal of a pose command of `entity` [m]. (num_envs,)"""
    return length(only(entity.data.site_pos_w[:, sites], "site") - goal_in_world(entity, command)) < tolerance


def object_at_goal(
    env: VecEnv, *, entity: Entity = "robot", object: Entity = "object", command: Command, tolerance: float
) -> Tensor:
    """An object is within `tolerance` of the goal of a pose command of `entity` [m]. (num_envs,)"""
    return length(object.data.root_pos_w - goal_in_world(entity, command)) < tolerance

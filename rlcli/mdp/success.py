"""Success conditions: they hold in the states in which an episode should end. (num_envs,) bool each."""

from __future__ import annotations

from torch import Tensor

from rlcli.mdp.parameters import Command, Entity, ManagedEnv, VecEnv
from rlcli.mdp.term_helpers import all_columns, angle_to_goal, constant, cosine, distance_to_goal, goal_in_world, single
from rlcli.sim.rotations import length, wrap_to_pi
from rlcli.task import Bodies, Joints, Sites


def joints_near(
    env: VecEnv, *, entity: Entity = "robot", joints: Joints = ".*", target: float = 0.0, tolerance: float
) -> Tensor:
    """Succeed where every joint is within `tolerance` of `target` [m or rad]. (num_envs,)

    The difference is wrapped to [-pi, pi].
    """
    data = entity.data
    angle = wrap_to_pi(data.joint_pos_of(joints) - target) if target else data.joint_angle_of(joints)
    return all_columns(angle.abs() < tolerance)


def root_moves(
    env: VecEnv,
    *,
    entity: Entity = "robot",
    direction: tuple[float, float, float] = (1.0, 0.0, 0.0),
    speed: float,
    limit_angle: float | None = None,
) -> Tensor:
    """Succeed where the root's velocity along `direction` is above `speed` [m/s]. (num_envs,)

    direction: unit vector, world frame. limit_angle: if given, the root's up axis must also be within this angle of the
    world's [rad].
    """
    x, y, z = entity.data.root_lin_vel_w.unbind(dim=1)
    moves = direction[0] * x + direction[1] * y + direction[2] * z > speed
    if limit_angle is None:
        return moves
    return moves & (-entity.data.projected_gravity_b[:, 2] > cosine(limit_angle))


def root_upright(
    env: VecEnv, *, entity: Entity = "robot", limit_angle: float, minimum_height: float | None = None
) -> Tensor:
    """Succeed where the root's up axis is within `limit_angle` [rad] of the world's. (num_envs,)

    minimum_height: if given, the root must also be higher than that above its environment's origin [m].
    """
    upright = -entity.data.projected_gravity_b[:, 2] > cosine(limit_angle)
    if minimum_height is None:
        return upright
    return upright & (entity.data.root_pos_w[:, 2] - env.origins[:, 2] > minimum_height)


def root_near(env: VecEnv, *, entity: Entity = "robot", target: tuple[float, float, float], tolerance: float) -> Tensor:
    """Succeed where the root is within `tolerance` [m] of `target`. (num_envs,)

    target: a point from the environment's origin [m].
    """
    return length(entity.data.root_pos_w - env.origins - constant(target, env.device)) < tolerance


def root_hovers(
    env: VecEnv, *, entity: Entity = "robot", goal: Entity = "target", tolerance: float, speed: float
) -> Tensor:
    """Succeed where the root is within `tolerance` [m] of the root of `goal`. (num_envs,)

    The root must also be slower than `speed` [m/s].
    """
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
    """Succeed where the root follows a velocity command. (num_envs,)

    linear_tolerance: largest error of the horizontal velocity [m/s]. angular_tolerance: of the yaw rate [rad/s]. Both
    in the root's frame.
    """
    data, commanded = entity.data, command.command
    linear = length(commanded[:, :2] - data.root_lin_vel_b[:, :2]) < linear_tolerance
    return linear & ((commanded[:, 2] - data.root_ang_vel_b[:, 2]).abs() < angular_tolerance)


def velocity_tracked_on_average(
    env: ManagedEnv, *, command: Command, linear_tolerance: float, angular_tolerance: float
) -> Tensor:
    """Succeed where the mean errors of a velocity command are within their tolerances. (num_envs,)

    The means are over the episode so far, with its start and its changes of command. linear_tolerance [m/s],
    angular_tolerance [rad/s].
    """
    running_mean = env.command_manager.running_mean
    linear = running_mean(command, "error_vel_xy") < linear_tolerance
    return linear & (running_mean(command, "error_vel_yaw") < angular_tolerance)


def body_at_goal(
    env: VecEnv,
    *,
    entity: Entity = "robot",
    bodies: Bodies,
    command: Command,
    tolerance: float,
    angle_tolerance: float | None = None,
) -> Tensor:
    """Succeed where a body is within `tolerance` [m] of the goal of a pose command of `entity`. (num_envs,)

    angle_tolerance: if given, the body's orientation must also be within this angle of the goal's [rad].
    """
    near = distance_to_goal(entity, bodies, command) < tolerance
    if angle_tolerance is None:
        return near
    return near & (angle_to_goal(entity, bodies, command) < angle_tolerance)


def site_at_goal(env: VecEnv, *, entity: Entity = "robot", sites: Sites, command: Command, tolerance: float) -> Tensor:
    """Succeed where a site is within `tolerance` [m] of the goal of a pose command of `entity`. (num_envs,)"""
    return length(single(entity.data.site_pos_w[:, sites], "site") - goal_in_world(entity, command)) < tolerance


def object_at_goal(
    env: VecEnv, *, entity: Entity = "robot", object: Entity = "object", command: Command, tolerance: float
) -> Tensor:
    """Succeed where an object is within `tolerance` [m] of the goal of a pose command of `entity`. (num_envs,)"""
    return length(object.data.root_pos_w - goal_in_world(entity, command)) < tolerance

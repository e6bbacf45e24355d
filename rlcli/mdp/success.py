"""Terms of `success:`, whose values are compared with `at_most` or `at_least`. (num_envs,) each."""

from __future__ import annotations

from torch import Tensor

from rlcli.mdp.parameter_types import Command, Entity, ManagedEnv, VecEnv
from rlcli.mdp.term_helpers import angle_to_goal, constant, distance_to_goal, goal_in_world, single
from rlcli.sim.rotations import length, wrap_to_pi
from rlcli.task import Bodies, Joints, Sites


def joint_error(env: VecEnv, *, entity: Entity = "robot", joints: Joints = ".*", target: float = 0.0) -> Tensor:
    """Largest distance of a joint from `target` [m or rad]. (num_envs,)

    The difference is wrapped to [-pi, pi].
    """
    data = entity.data
    error = wrap_to_pi(data.joint_pos_of(joints) - target) if target else data.joint_angle_of(joints)
    return error.abs()[:, 0] if error.shape[1] == 1 else error.abs().amax(dim=1)


def root_velocity(
    env: VecEnv, *, entity: Entity = "robot", direction: tuple[float, float, float] = (1.0, 0.0, 0.0)
) -> Tensor:
    """Velocity of the root along `direction` [m/s]. (num_envs,)

    direction: unit vector, world frame.
    """
    x, y, z = entity.data.root_lin_vel_w.unbind(dim=1)
    return direction[0] * x + direction[1] * y + direction[2] * z


def root_speed(env: VecEnv, *, entity: Entity = "robot") -> Tensor:
    """Magnitude of the root's velocity [m/s]. (num_envs,)"""
    return length(entity.data.root_lin_vel_w)


def root_tilt(env: VecEnv, *, entity: Entity = "robot") -> Tensor:
    """Angle between the root's up axis and the world's [rad]. (num_envs,)"""
    return (-entity.data.projected_gravity_b[:, 2]).clamp(-1.0, 1.0).acos()


def root_height(env: VecEnv, *, entity: Entity = "robot") -> Tensor:
    """Height of the root above its environment's origin [m]. (num_envs,)"""
    return entity.data.root_pos_w[:, 2] - env.origins[:, 2]


def root_distance(env: VecEnv, *, entity: Entity = "robot", target: tuple[float, float, float]) -> Tensor:
    """Distance of the root from `target` [m]. (num_envs,)

    target: a point from the environment's origin [m].
    """
    return length(entity.data.root_pos_w - env.origins - constant(target, env.device))


def root_distance_to(env: VecEnv, *, entity: Entity = "robot", goal: Entity = "target") -> Tensor:
    """Distance of the root from the root of `goal` [m]. (num_envs,)"""
    return length(entity.data.root_pos_w - goal.data.root_pos_w)


def velocity_error(env: VecEnv, *, entity: Entity = "robot", command: Command) -> Tensor:
    """Error of the root's horizontal velocity under a velocity command [m/s], root frame. (num_envs,)"""
    return length(command.command[:, :2] - entity.data.root_lin_vel_b[:, :2])


def yaw_rate_error(env: VecEnv, *, entity: Entity = "robot", command: Command) -> Tensor:
    """Error of the root's yaw rate under a velocity command [rad/s], root frame. (num_envs,)"""
    return (command.command[:, 2] - entity.data.root_ang_vel_b[:, 2]).abs()


def mean_velocity_error(env: ManagedEnv, *, command: Command) -> Tensor:
    """Mean error of a velocity command's horizontal velocity over the episode so far [m/s]. (num_envs,)

    The mean includes the start of the episode and changes of the command.
    """
    return env.command_manager.running_mean(command, "error_vel_xy")


def mean_yaw_rate_error(env: ManagedEnv, *, command: Command) -> Tensor:
    """Mean error of a velocity command's yaw rate over the episode so far [rad/s]. (num_envs,)

    The mean includes the start of the episode and changes of the command.
    """
    return env.command_manager.running_mean(command, "error_vel_yaw")


def body_goal_distance(env: VecEnv, *, entity: Entity = "robot", bodies: Bodies, command: Command) -> Tensor:
    """Distance of a body from the goal of a pose command of `entity` [m]. (num_envs,)"""
    return distance_to_goal(entity, bodies, command)


def body_goal_angle(env: VecEnv, *, entity: Entity = "robot", bodies: Bodies, command: Command) -> Tensor:
    """Angle of a body from the goal orientation of a pose command of `entity` [rad]. (num_envs,)"""
    return angle_to_goal(entity, bodies, command)


def site_goal_distance(env: VecEnv, *, entity: Entity = "robot", sites: Sites, command: Command) -> Tensor:
    """Distance of a site from the goal of a pose command of `entity` [m]. (num_envs,)"""
    return length(single(entity.data.site_pos_w[:, sites], "site") - goal_in_world(entity, command))


def object_goal_distance(
    env: VecEnv, *, entity: Entity = "robot", object: Entity = "object", command: Command
) -> Tensor:
    """Distance of an object from the goal of a pose command of `entity` [m]. (num_envs,)"""
    return length(object.data.root_pos_w - goal_in_world(entity, command))

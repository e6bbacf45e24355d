"""Reward terms of manipulation: reach a pose, grasp and lift an object, open a drawer. (num_envs,) each."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rlcli.mdp.parameter_types import Command, Entity, ManagedEnv
from rlcli.mdp.term_helpers import HandleTerm, angle_to_goal, distance_to_goal, goal_in_world, single
from rlcli.sim.rotations import axis_x, axis_y, axis_z, length, turn_between
from rlcli.task import Bodies, Joints, Sites

# --- pose commands: position and quaternion in the root's frame ---


def position_command_error(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, command: Command) -> Tensor:
    """Distance from a body to the goal of a pose command [m]. (num_envs,)"""
    return distance_to_goal(entity, bodies, command)


def position_command_error_tanh(
    env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, command: Command, std: float
) -> Tensor:
    """1 - tanh(d / std), where d is the distance from a body to the goal of a pose command [m]. (num_envs,)"""
    return _near(distance_to_goal(entity, bodies, command), std)


def orientation_command_error(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, command: Command) -> Tensor:
    """Angle between a body's orientation and the goal of a pose command [rad]. (num_envs,)"""
    return angle_to_goal(entity, bodies, command)


def orientation_command_error_tanh(
    env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, command: Command, std: float
) -> Tensor:
    """1 - tanh(angle / std), with the angle between a body's orientation and the goal's [rad]. (num_envs,)"""
    return _near(orientation_command_error(env, entity=entity, bodies=bodies, command=command), std)


def goal_distance_tanh(env: ManagedEnv, *, command: Command, std: float) -> Tensor:
    """1 - tanh(d / std), where d is the distance from the root to the goal of its own pose command [m]. (num_envs,)

    Isaac Lab: `position_command_error_tanh` of its navigation task.
    """
    return _near(length(command.command[:, :3]), std)


# --- objects and handles ---


def object_is_lifted(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    object: Entity = "object",
    minimal_height: float,
    sites: Sites | None = None,
    held_within: float | None = None,
) -> Tensor:
    """1 where an object is higher than `minimal_height` [m] above its environment's origin. (num_envs,)

    held_within: distance of the object from the site of `entity` [m] above which the value is 0, as after a throw.
    """
    lifted = object.data.root_pos_w[:, 2] - env.origins[:, 2] > minimal_height
    if held_within is None:
        return lifted
    return lifted & (_distance_to_object(entity, sites, object) <= held_within)


def object_ee_distance(
    env: ManagedEnv, *, entity: Entity = "robot", sites: Sites, object: Entity = "object", std: float
) -> Tensor:
    """1 - tanh(d / std), where d is the distance from a site of `entity` to an object [m]. (num_envs,)"""
    return _near(_distance_to_object(entity, sites, object), std)


def grasp_object(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    joints: Joints,
    sites: Sites,
    object: Entity = "object",
    threshold: float,
    open_joint_pos: float,
) -> Tensor:
    """Sum of (open_joint_pos - position) of the finger `joints`, where a site is near an object [m]. (num_envs,)

    Near means within `threshold` [m]; elsewhere the value is 0.
    """
    closed: Tensor = (open_joint_pos - entity.data.joint_pos_of(joints)).sum(dim=1)
    return closed * (_distance_to_object(entity, sites, object) <= threshold)


def object_goal_distance(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    object: Entity = "object",
    command: Command,
    std: float,
    minimal_height: float,
    sites: Sites | None = None,
    held_within: float | None = None,
) -> Tensor:
    """1 - tanh(d / std), where d is the distance from an object to the goal of a pose command [m]. (num_envs,)

    0 where `object_is_lifted`, with the same parameters, is 0.
    """
    distance = length(goal_in_world(entity, command) - object.data.root_pos_w)
    return _near(distance, std) * object_is_lifted(
        env, entity=entity, object=object, minimal_height=minimal_height, sites=sites, held_within=held_within
    )


def success_bonus(env: ManagedEnv, *, object: Entity = "object", command: Command, threshold: float = 0.1) -> Tensor:
    """1 where an object's orientation is within `threshold` [rad] of the goal's. (num_envs,)

    The goal is in columns 3 to 6 of the command, world frame.
    """
    return turn_between(object.data.root_quat_w, command.command[:, 3:7]) <= threshold


def track_pos_l2(env: ManagedEnv, *, object: Entity = "object", command: Command) -> Tensor:
    """Distance from an object to the goal [m]. (num_envs,)

    The goal is in columns 0 to 2 of the command, from the environment's origin.
    """
    return length(command.command[:, :3] + env.origins - object.data.root_pos_w)


def track_orientation_inv_l2(
    env: ManagedEnv, *, object: Entity = "object", command: Command, rot_eps: float = 1e-3
) -> Tensor:
    """1 / (angle + rot_eps) [1/rad], where angle is that between the object's orientation and the goal's. (num_envs,)

    The goal is in columns 3 to 6 of the command, world frame. rot_eps [rad].
    """
    return 1.0 / (turn_between(object.data.root_quat_w, command.command[:, 3:7]) + rot_eps)


@dataclass(kw_only=True, eq=False)
class ApproachEeHandle(HandleTerm):
    """(1 / (1 + d^2))^2 for the distance d from a site to a handle, doubled where d <= `threshold` [m]. (num_envs,)"""

    threshold: float

    def __call__(self) -> Tensor:
        """Return the value of the reward term. (num_envs,)"""
        distance = length(self.offset_to_handle())
        near = (1.0 / (1.0 + distance.square())).square_()
        return torch.where(distance <= self.threshold, 2.0 * near, near)


class AlignEeHandle(HandleTerm):
    """Alignment of a gripper site with a handle: 1 aligned, -1 opposite. (num_envs,)

    (sign(a) a^2 + sign(b) b^2) / 2. a: cosine between the site's z axis and the handle's -x axis. b: cosine between the
    site's x axis and the handle's -y axis.
    """

    def __call__(self) -> Tensor:
        """Return the value of the reward term. (num_envs,)"""
        site, handle = self.orientations()
        grip = -(axis_z(site) * axis_x(handle)).sum(dim=1)
        turn = -(axis_x(site) * axis_y(handle)).sum(dim=1)
        return 0.5 * (grip.sign() * grip.square() + turn.sign() * turn.square())


@dataclass(kw_only=True, eq=False)
class GraspHandle(HandleTerm):
    """Sum of (open_joint_pos - position) of the finger `joints`, where a site is near a handle [m]. (num_envs,)

    Near means within `threshold` [m]; elsewhere the value is 0.
    """

    joints: Joints
    threshold: float
    open_joint_pos: float

    def __call__(self) -> Tensor:
        """Return the value of the reward term. (num_envs,)"""
        closed: Tensor = (self.open_joint_pos - self.entity.data.joint_pos_of(self.joints)).sum(dim=1)
        return closed * (length(self.offset_to_handle()) <= self.threshold)


def open_drawer_bonus(env: ManagedEnv, *, entity: Entity = "cabinet", joints: Joints) -> Tensor:
    """Sum of the positions of joints of a cabinet [m]. (num_envs,)  Isaac Lab: doubled while the handle is held."""
    return entity.data.joint_pos_of(joints).sum(dim=1)


def multi_stage_open_drawer(env: ManagedEnv, *, entity: Entity = "cabinet", joints: Joints) -> Tensor:
    """0.5 where a drawer is open by more than 0.01 m, plus 1 above 0.2 m, plus 1 above 0.3 m. (num_envs,)

    Isaac Lab: the last two only while the handle is held.
    """
    opening = single(entity.data.joint_pos_of(joints), "joint")
    return 0.5 * (opening > 0.01) + (opening > 0.2) + (opening > 0.3)


def _near(distance: Tensor, std: float) -> Tensor:
    return 1.0 - torch.tanh(distance / std)


def _distance_to_object(entity: Entity, sites: Sites | None, object: Entity) -> Tensor:
    """Return the distance from the one selected site of `entity` to an object [m]. (num_envs,)

    Raises:
        ValueError: if not exactly one site is selected.
    """
    if sites is None:
        raise ValueError("'held_within' needs 'sites': the site of the gripper from which the distance is measured")
    return length(object.data.root_pos_w - single(entity.data.site_pos_w[:, sites], "site"))

"""Reward terms of reaching, lifting, placing and opening. (num_envs,) each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rlcli.mdp.parameters import Command, Entity
from rlcli.mdp.term_helpers import HandleTerm, goal_in_world, goal_quat_in_world, only
from rlcli.sim.rotations import axis_x, axis_y, axis_z, length, turn_between
from rlcli.task import Bodies, Joints, Sites

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv


# --- pose commands: position and quaternion in the root's frame ---


def position_command_error(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, command: Command) -> Tensor:
    """Distance from a body to the goal of a pose command [m]. (num_envs,)"""
    return length(only(entity.data.body_pos_w[:, bodies], "body") - goal_in_world(entity, command))


def position_command_error_tanh(
    env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, command: Command, std: float
) -> Tensor:
    """1 - tanh(distance / std), the distance from a body to the goal of a pose command; std [m]. (num_envs,)"""
    return _near(length(only(entity.data.body_pos_w[:, bodies], "body") - goal_in_world(entity, command)), std)


def orientation_command_error(env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, command: Command) -> Tensor:
    """Angle between a body's attitude and the goal's of a pose command [rad]. (num_envs,)"""
    return turn_between(
        only(entity.data.body_quat_w[:, bodies], "body").contiguous(), goal_quat_in_world(entity, command)
    )


def orientation_command_error_tanh(
    env: ManagedEnv, *, entity: Entity = "robot", bodies: Bodies, command: Command, std: float
) -> Tensor:
    """1 - tanh(angle / std), the angle between a body's attitude and the goal's; std [rad]. (num_envs,)"""
    return _near(orientation_command_error(env, entity=entity, bodies=bodies, command=command), std)


def goal_distance_tanh(env: ManagedEnv, *, command: Command, std: float) -> Tensor:
    """1 - tanh(distance / std) to the goal of a pose command of the root itself; std [m]. (num_envs,)

    Isaac Lab: `position_command_error_tanh` of its navigation task.
    """
    return _near(length(command.command[:, :3]), std)


# --- objects and handles ---


def object_is_lifted(env: ManagedEnv, *, object: Entity = "object", minimal_height: float) -> Tensor:
    """1 where an object is higher than `minimal_height` [m] above its environment's origin. (num_envs,)"""
    return object.data.root_pos_w[:, 2] - env.origins[:, 2] > minimal_height


def object_ee_distance(
    env: ManagedEnv, *, entity: Entity = "robot", sites: Sites, object: Entity = "object", std: float
) -> Tensor:
    """1 - tanh(distance / std) from a site of `entity` to an object; std [m]. (num_envs,)"""
    return _near(length(object.data.root_pos_w - only(entity.data.site_pos_w[:, sites], "site")), std)


def object_goal_distance(
    env: ManagedEnv,
    *,
    entity: Entity = "robot",
    object: Entity = "object",
    command: Command,
    std: float,
    minimal_height: float,
) -> Tensor:
    """1 - tanh(distance / std) from an object to the goal of a pose command, once lifted; std [m]. (num_envs,)"""
    distance = length(goal_in_world(entity, command) - object.data.root_pos_w)
    return _near(distance, std) * (object.data.root_pos_w[:, 2] - env.origins[:, 2] > minimal_height)


def success_bonus(env: ManagedEnv, *, object: Entity = "object", command: Command, threshold: float = 0.1) -> Tensor:
    """1 where an object's attitude is within `threshold` [rad] of the goal's. (num_envs,)

    The goal is columns 3 to 6 of the command, in the world frame.
    """
    return turn_between(object.data.root_quat_w, command.command[:, 3:7]) <= threshold


def track_pos_l2(env: ManagedEnv, *, object: Entity = "object", command: Command) -> Tensor:
    """Distance from an object to the goal, columns 0 to 2 of a command in its environment's frame [m]. (num_envs,)"""
    return length(command.command[:, :3] + env.origins - object.data.root_pos_w)


def track_orientation_inv_l2(
    env: ManagedEnv, *, object: Entity = "object", command: Command, rot_eps: float = 1e-3
) -> Tensor:
    """1 / (angle + rot_eps) between an object's attitude and the goal's, world frame [1/rad]. (num_envs,)"""
    return 1.0 / (turn_between(object.data.root_quat_w, command.command[:, 3:7]) + rot_eps)


@dataclass(kw_only=True, eq=False)
class ApproachEeHandle(HandleTerm):
    """(1 / (1 + distance^2))^2 from a site to a handle, doubled where it is within `threshold` [m]. (num_envs,)"""

    threshold: float

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        distance = length(self.way_to_handle())
        near = (1.0 / (1.0 + distance.square())).square_()
        return torch.where(distance <= self.threshold, 2.0 * near, near)


class AlignEeHandle(HandleTerm):
    """How well a site's z axis points against a handle's x axis, and its x axis against its y axis. (num_envs,)

    (sign(a) a^2 + sign(b) b^2) / 2 of the two cosines: 1 aligned.
    """

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        site, handle = self.attitudes()
        grip = -(axis_z(site) * axis_x(handle)).sum(dim=1)
        turn = -(axis_x(site) * axis_y(handle)).sum(dim=1)
        return 0.5 * (grip.sign() * grip.square() + turn.sign() * turn.square())


class GraspHandle(HandleTerm):
    """How far `joints`, the fingers, are closed where a site is within `threshold` [m] of a handle [m]. (num_envs,)

    The sum of open_joint_pos - position.
    """

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        sites: Sites,
        joints: Joints,
        cabinet: Entity = "cabinet",
        handle: str,
        threshold: float,
        open_joint_pos: float,
    ) -> None:
        super().__init__(env, entity=entity, sites=sites, cabinet=cabinet, handle=handle)
        self._joints, self._threshold, self._open = joints, threshold, open_joint_pos

    def __call__(self) -> Tensor:
        """(num_envs,)"""
        closed: Tensor = (self._open - self.entity.data.joint_pos_of(self._joints)).sum(dim=1)
        return closed * (length(self.way_to_handle()) <= self._threshold)


def open_drawer_bonus(env: ManagedEnv, *, entity: Entity = "cabinet", joints: Joints) -> Tensor:
    """How far joints of a cabinet are open, summed [m]. (num_envs,)  Isaac Lab: doubled while the handle is held."""
    return entity.data.joint_pos_of(joints).sum(dim=1)


def multi_stage_open_drawer(env: ManagedEnv, *, entity: Entity = "cabinet", joints: Joints) -> Tensor:
    """0.5 for a drawer open by 0.01 m, 1 more by 0.2 m, 1 more by 0.3 m. (num_envs,)

    Isaac Lab: the last two while the handle is held.
    """
    opening = only(entity.data.joint_pos_of(joints), "joint")
    return 0.5 * (opening > 0.01) + (opening > 0.2) + (opening > 0.3)


def _near(distance: Tensor, std: float) -> Tensor:
    return 1.0 - torch.tanh(distance / std)

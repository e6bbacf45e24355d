"""Event terms: each acts on a `Selection` of environments, whose draws depend on nothing but seed, term and episode."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from rlcli.sim.rotations import from_euler, multiply
from rlcli.sim.selection import Selection
from rlcli.task import Bodies, Entity, Joints, Range

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv


def reset_joints_by_offset(
    env: ManagedEnv,
    selection: Selection,
    *,
    entity: Entity = "robot",
    joints: Joints = ".*",
    position: Range = (0.0, 0.0),
    velocity: Range = (0.0, 0.0),
) -> None:
    """Default joint state plus uniform offsets [m or rad, m/s or rad/s], positions kept within the soft limits."""
    default_pos, default_vel = _defaults(entity, selection, joints)
    offset = selection.uniform(*_bounds(env.device, position, velocity), (2, default_pos.shape[1]))
    _write_joints(entity, selection, joints, default_pos + offset[:, 0], default_vel + offset[:, 1])


def reset_joints_by_scale(
    env: ManagedEnv,
    selection: Selection,
    *,
    entity: Entity = "robot",
    joints: Joints = ".*",
    position: Range = (1.0, 1.0),
    velocity: Range = (1.0, 1.0),
) -> None:
    """Default joint state times uniform factors, positions kept within the soft limits."""
    default_pos, default_vel = _defaults(entity, selection, joints)
    factor = selection.uniform(*_bounds(env.device, position, velocity), (2, default_pos.shape[1]))
    _write_joints(entity, selection, joints, default_pos * factor[:, 0], default_vel * factor[:, 1])


def reset_root_state_uniform(
    env: ManagedEnv,
    selection: Selection,
    *,
    entity: Entity = "robot",
    x: Range = (0.0, 0.0),
    y: Range = (0.0, 0.0),
    z: Range = (0.0, 0.0),
    roll: Range = (0.0, 0.0),
    pitch: Range = (0.0, 0.0),
    yaw: Range = (0.0, 0.0),
    linear_velocity: list[Range] = [(0.0, 0.0), (0.0, 0.0), (0.0, 0.0)],  # noqa: B006 (read, never written)
    angular_velocity: list[Range] = [(0.0, 0.0), (0.0, 0.0), (0.0, 0.0)],  # noqa: B006
) -> None:
    """Default root state at the environment's origin plus uniform offsets [m, rad, m/s, rad/s], world frame."""
    default = selection.read(entity.data.default_root_state)
    offset = selection.uniform(*_bounds(env.device, x, y, z), (3, 1)).squeeze(2)
    turn = from_euler(*selection.uniform(*_bounds(env.device, roll, pitch, yaw), (3, 1)).squeeze(2).unbind(1))
    velocity = selection.uniform(*_bounds(env.device, *linear_velocity, *angular_velocity), (6, 1)).squeeze(2)
    place = default[:, :3] + selection.peek(env.origins) + offset
    entity.write_root_pose(selection, place, multiply(default[:, 3:7], turn))
    entity.write_root_velocity(selection, default[:, 7:10] + velocity[:, :3], default[:, 10:] + velocity[:, 3:])


def reset_scene_to_default(env: ManagedEnv, selection: Selection) -> None:
    """Every entity to its default state."""
    for entity in env.entities.values():
        data = entity.data
        if entity.joint_names:
            entity.write_joint_positions(selection, selection.read(data.default_joint_pos))
            entity.write_joint_velocities(selection, selection.read(data.default_joint_vel))
        root = selection.read(data.default_root_state)
        if entity.is_floating or entity.mocap >= 0:
            entity.write_root_pose(selection, root[:, :3] + selection.peek(env.origins), root[:, 3:7])
        if entity.is_floating:
            entity.write_root_velocity(selection, root[:, 7:10], root[:, 10:])


def push_by_setting_velocity(
    env: ManagedEnv,
    selection: Selection,
    *,
    entity: Entity = "robot",
    linear_velocity: list[Range] = [(0.0, 0.0), (0.0, 0.0), (0.0, 0.0)],  # noqa: B006
    angular_velocity: list[Range] = [(0.0, 0.0), (0.0, 0.0), (0.0, 0.0)],  # noqa: B006
) -> None:
    """Add a uniform draw to the root's velocity, world frame [m/s, rad/s]."""
    push = selection.uniform(*_bounds(env.device, *linear_velocity, *angular_velocity), (6, 1)).squeeze(2)
    linear, angular = entity.read_root_velocity(selection)
    entity.write_root_velocity(selection, linear + push[:, :3], angular + push[:, 3:])


def apply_external_force_torque(
    env: ManagedEnv,
    selection: Selection,
    *,
    entity: Entity = "robot",
    bodies: Bodies = ".*",
    force: Range = (0.0, 0.0),
    torque: Range = (0.0, 0.0),
) -> None:
    """A uniform wrench on bodies, world frame, each component drawn [N, N m]; it lasts until changed or reset."""
    wrench = entity.engine.field("xfrc_applied").view(env.num_envs, -1)
    columns = _wrench_columns(entity, bodies)
    shape = (len(columns) // 6, 3)
    drawn = torch.cat([selection.uniform(*force, shape), selection.uniform(*torque, shape)], dim=2)
    selection.write(wrench, drawn.flatten(1), columns)


def _bounds(device: torch.device, *ranges: Range | Tensor) -> tuple[Tensor, Tensor]:
    """Lower and upper ends of several ranges, for draws of shape (rows, ranges, k). (ranges, 1) each"""
    if any(isinstance(ends, Tensor) for ends in ranges):  # a curriculum moves them
        both = torch.stack([ends if isinstance(ends, Tensor) else _fixed(device, ends)[0] for ends in ranges])
    else:
        both = _fixed(device, *ranges)
    low, high = both.split(1, dim=1)
    return low, high


@functools.lru_cache
def _fixed(device: torch.device, *ranges: Range) -> Tensor:
    return torch.tensor(ranges, device=device)


def _wrench_columns(entity: Entity, bodies: Bodies) -> Tensor:
    """Where the wrenches of bodies lie in `xfrc_applied`, a row of it flattened. (6 k,)"""
    cache = entity.__dict__.setdefault("_wrench_columns", {})
    if id(bodies) not in cache:
        device = entity.engine.device
        ids = torch.as_tensor(entity.body_ids, device=device)[bodies]
        cache[id(bodies)] = bodies, (ids[:, None] * 6 + torch.arange(6, device=device)).flatten()
    return cache[id(bodies)][1]


def _defaults(entity: Entity, selection: Selection, joints: Joints) -> tuple[Tensor, Tensor]:
    data = entity.data
    return selection.peek(data.default_joint_pos, joints), selection.peek(data.default_joint_vel, joints)


def _write_joints(entity: Entity, selection: Selection, joints: Joints, position: Tensor, velocity: Tensor) -> None:
    limits = entity.data.soft_joint_pos_limits
    entity.write_joint_positions(selection, position.clamp_(limits[joints, 0], limits[joints, 1]), joints)
    entity.write_joint_velocities(selection, velocity, joints)

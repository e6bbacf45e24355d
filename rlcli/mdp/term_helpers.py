"""Helpers for terms of several sections: goals, distances, contacts. This module has no terms."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rlcli.mdp.parameter_types import Command
from rlcli.mdp.term import EntityTerm
from rlcli.sim.env_selection import Columns
from rlcli.sim.rotations import length, multiply, rotate, turn_between
from rlcli.task import ContactSensor, Entity, Sites


def constant(values: Sequence[float] | Tensor, device: torch.device) -> Tensor:
    """Return numbers of the configuration as a cached tensor: a step captured as a CUDA graph cannot create tensors."""
    return values if isinstance(values, Tensor) else _constant(tuple(values), device)


def cosine(angle: float | Tensor) -> float | Tensor:
    """Return the cosine of a setting [rad], which is a tensor if a curriculum changes it."""
    return angle.cos() if isinstance(angle, Tensor) else math.cos(angle)


def sum_columns(values: Tensor) -> Tensor:
    """Return the sum over the columns. (n, k) -> (n,)

    A single column is returned without a sum: torch needs ten times as long for the reduction.
    """
    return values[:, 0] if values.shape[1] == 1 else values.sum(dim=1)


def any_column(masks: Tensor) -> Tensor:
    """Return whether a mask holds in any column; a single column needs no reduction. (n, k) -> (n,) bool"""
    return masks[:, 0] if masks.shape[1] == 1 else masks.any(dim=1)


def all_columns(masks: Tensor) -> Tensor:
    """Return whether a mask holds in all columns; a single column needs no reduction. (n, k) -> (n,) bool"""
    return masks[:, 0] if masks.shape[1] == 1 else masks.all(dim=1)


def single(values: Tensor, kind: str) -> Tensor:
    """Return `values[:, 0]` of a tensor (num_envs, 1, ...): the values of the only selected element.

    Args:
        values: values of the selected elements. (num_envs, k, ...)
        kind: name of an element for the message, such as `site`.

    Raises:
        ValueError: if there is not exactly one element.
    """
    if values.shape[1] != 1:
        raise ValueError(f"the term needs exactly one {kind}; {values.shape[1]} are selected")
    return values[:, 0]


def require_one_per_body(values: Tensor, sensor: ContactSensor, key: str) -> Tensor:
    """Check that values have one element for each body of a contact sensor, and return the values.

    Args:
        values: values of the selected elements. (num_envs, k, ...)
        sensor: the sensor.
        key: the term's key that selects the elements, such as `sites`.

    Raises:
        ValueError: if the number of elements differs from the number of bodies.
    """
    if values.shape[1] != sensor.found.shape[1]:
        found, wanted = values.shape[1], sensor.found.shape[1]
        raise ValueError(f"`{key}` selects {found} elements; select {wanted}, one for each body of the sensor")
    return values


def on_host(index: Columns) -> Columns:
    """Return an index of elements that works on CPU tensors."""
    return index.cpu() if isinstance(index, Tensor) else index


def column_numbers(index: Columns, count: int) -> list[int]:
    """Return the positions that an index into `count` elements selects."""
    numbers: list[int] = torch.arange(count)[on_host(index)].tolist()
    return numbers


@dataclass(kw_only=True, eq=False)
class HandleTerm(EntityTerm):
    """Base class of terms that compare one site of `entity`, such as a gripper, with the site `handle` of `cabinet`."""

    sites: Sites
    cabinet: Entity = "cabinet"
    handle: str

    def __post_init__(self) -> None:
        self._handle = self.cabinet.select("Sites", self.handle)[0]

    def offset_to_handle(self) -> Tensor:
        """Return the vector from the site to the handle, world frame [m]. (num_envs, 3)"""
        handle = single(self.cabinet.data.site_pos_w[:, self._handle], "handle")
        return handle - single(self.entity.data.site_pos_w[:, self.sites], "site")

    def orientations(self) -> tuple[Tensor, Tensor]:
        """Return the quaternions (w, x, y, z) of the site and of the handle, world frame. (num_envs, 4) each"""
        site = single(self.entity.data.site_quat_w[:, self.sites], "site")
        return site, single(self.cabinet.data.site_quat_w[:, self._handle], "handle")


def strongest_force(sensor: ContactSensor) -> Tensor:
    """Return the largest contact force of each body within the sensor's history. (num_envs, k) [N]"""
    return length(sensor.force_history).amax(dim=1)


def commanded_speed(command: Command) -> Tensor:
    """Return the horizontal speed of a velocity command. (num_envs,) [m/s]"""
    return length(command.command[:, :2])


def is_moving(entity: Entity, command: Command, velocity_threshold: float) -> Tensor:
    """Return whether the command is nonzero or the root is faster than the threshold [m/s]. (num_envs,) bool"""
    speed = length(entity.data.root_lin_vel_b[:, :2])
    return (length(command.command) > 0.0) | (speed > velocity_threshold)


def goal_in_world(entity: Entity, command: Command) -> Tensor:
    """Return the goal position of a pose command, converted from the root's into the world frame. (num_envs, 3) [m]"""
    data = entity.data

    def compute() -> Tensor:
        goal: Tensor = data.root_pos_w + rotate(data.root_quat_w, command.command[:, :3])
        return goal

    return _once(entity, command, ("goal position",), compute)


def goal_quat_in_world(entity: Entity, command: Command) -> Tensor:
    """Return the goal quaternion of a pose command, turned from the root's into the world frame. (num_envs, 4)"""
    return _once(entity, command, ("goal quat",), lambda: multiply(entity.data.root_quat_w, command.command[:, 3:7]))


def distance_to_goal(entity: Entity, bodies: Columns, command: Command) -> Tensor:
    """Return the distance from a body to the goal of a pose command. (num_envs,) [m]"""

    def compute() -> Tensor:
        return length(single(entity.data.body_pos_w[:, bodies], "body") - goal_in_world(entity, command))

    return _once(entity, command, ("distance", id(bodies)), compute)


def angle_to_goal(entity: Entity, bodies: Columns, command: Command) -> Tensor:
    """Return the angle between a body's orientation and the goal of a pose command. (num_envs,) [rad]"""

    def compute() -> Tensor:
        orientation = single(entity.data.body_quat_w[:, bodies], "body").contiguous()
        return turn_between(orientation, goal_quat_in_world(entity, command))

    return _once(entity, command, ("angle", id(bodies)), compute)


def _once(entity: Entity, command: Command, key: tuple[object, ...], compute: Callable[[], Tensor]) -> Tensor:
    """Return `compute()`, called once per step for all terms that need the quantity; do not write to the result.

    Args:
        entity: the entity of the quantity.
        command: the command of the quantity.
        key: name of the quantity.
        compute: function that computes the quantity.
    """
    value: Tensor = entity.sim.once_per_goal((entity.name, id(command), *key), command.command, compute)
    return value


@functools.cache
def _constant(values: tuple[float, ...], device: torch.device) -> Tensor:
    return torch.tensor(values, device=device)

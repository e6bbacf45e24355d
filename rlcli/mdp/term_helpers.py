"""What terms of several sections have in common: goals, distances, contacts. No terms."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from rlcli.mdp.parameters import Command
from rlcli.mdp.term import Term
from rlcli.sim.rotations import length, multiply, rotate
from rlcli.task import ContactSensor, Entity, Sites


def vector(values: Sequence[float] | Tensor, device: torch.device) -> Tensor:
    """Numbers of a configuration as a tensor, made once: a recorded step makes no tensors of Python's numbers."""
    return values if isinstance(values, Tensor) else _constant(tuple(values), device)


def cosine(angle: float | Tensor) -> float | Tensor:
    """Of a number of the configuration, which a curriculum may have made a tensor."""
    return angle.cos() if isinstance(angle, Tensor) else math.cos(angle)


def total(values: Tensor) -> Tensor:
    """Sum over the columns; torch takes ten times as long for the sum of one as for the column. (n, k) -> (n,)"""
    return values[:, 0] if values.shape[1] == 1 else values.sum(dim=1)


def some(masks: Tensor) -> Tensor:
    """Where some column holds; as `total`, without a reduction where there is one column. (n, k) -> (n,) bool"""
    return masks[:, 0] if masks.shape[1] == 1 else masks.any(dim=1)


def every(masks: Tensor) -> Tensor:
    """Where every column holds, likewise. (n, k) -> (n,) bool"""
    return masks[:, 0] if masks.shape[1] == 1 else masks.all(dim=1)


def only(values: Tensor, what: str) -> Tensor:
    """The single element of (num_envs, 1, ...).

    Raises:
        ValueError: if there are several, or none.
    """
    if values.shape[1] != 1:
        raise ValueError(f"needs exactly one {what}, and {values.shape[1]} are selected")
    return values[:, 0]


def paired(values: Tensor, sensor: ContactSensor) -> Tensor:
    """Values of one element a slot of the sensor.

    Raises:
        ValueError: if their numbers differ.
    """
    if values.shape[1] != sensor.found.shape[1]:
        raise ValueError(f"selects {values.shape[1]} elements, the sensor has {sensor.found.shape[1]} bodies")
    return values


@dataclass(kw_only=True, eq=False)
class HandleTerm(Term):
    """Base of terms of a site of `entity` and a site, `handle`, of another entity."""

    entity: Entity = "robot"
    sites: Sites
    cabinet: Entity = "cabinet"
    handle: str

    def __post_init__(self) -> None:
        self._handle = self.cabinet.select("Sites", self.handle)[0]

    def way_to_handle(self) -> Tensor:
        """Return the way from the site to the handle, world frame [m]. (num_envs, 3)"""
        handle = only(self.cabinet.data.site_pos_w[:, self._handle], "handle")
        return handle - only(self.entity.data.site_pos_w[:, self.sites], "site")

    def attitudes(self) -> tuple[Tensor, Tensor]:
        """Return the attitudes of the site and of the handle, world frame. (num_envs, 4) each"""
        site = only(self.entity.data.site_quat_w[:, self.sites], "site")
        return site, only(self.cabinet.data.site_quat_w[:, self._handle], "handle")


def strongest_force(sensor: ContactSensor) -> Tensor:
    """Largest size of each body's contact force over the sensor's history. (num_envs, k) [N]"""
    return length(sensor.force_history).amax(dim=1)


def asked_speed(command: Command) -> Tensor:
    """Speed in the plane that a velocity command asks for. (num_envs,) [m/s]"""
    return length(command.command[:, :2])


def is_moving(entity: Entity, command: Command, velocity_threshold: float) -> Tensor:
    """Environments with a nonzero command, or whose root is faster than the threshold. (num_envs,) bool"""
    speed = length(entity.data.root_lin_vel_b[:, :2])
    return (length(command.command) > 0.0) | (speed > velocity_threshold)


def goal_in_world(entity: Entity, command: Command) -> Tensor:
    """Position that a pose command, given in the root's frame, stands for. (num_envs, 3) [m]"""
    goal: Tensor = entity.data.root_pos_w + rotate(entity.data.root_quat_w, command.command[:, :3])
    return goal


def goal_quat_in_world(entity: Entity, command: Command) -> Tensor:
    """Attitude that a pose command, given in the root's frame, stands for. (num_envs, 4)"""
    return multiply(entity.data.root_quat_w, command.command[:, 3:7])


@functools.cache
def _constant(values: tuple[float, ...], device: torch.device) -> Tensor:
    return torch.tensor(values, device=device)

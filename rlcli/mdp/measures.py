"""What terms of several sections have in common: goals, distances, contacts. No terms."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from rlcli.sim.rotations import length, multiply, rotate
from rlcli.task import ContactSensor, Entity


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


def strongest_force(sensor: ContactSensor) -> Tensor:
    """Largest size of each body's contact force over the sensor's history. (num_envs, k) [N]"""
    return length(sensor.force_history).amax(dim=1)


def asked_speed(command: Any) -> Tensor:
    """Speed in the plane that a velocity command asks for. (num_envs,) [m/s]"""
    return length(command.command[:, :2])


def goal_in_world(entity: Entity, command: Any) -> Tensor:
    """Position that a pose command, given in the root's frame, stands for. (num_envs, 3) [m]"""
    return entity.data.root_pos_w + rotate(entity.data.root_quat_w, command.command[:, :3])


def goal_quat_in_world(entity: Entity, command: Any) -> Tensor:
    """Attitude that a pose command, given in the root's frame, stands for. (num_envs, 4)"""
    return multiply(entity.data.root_quat_w, command.command[:, 3:7])


@functools.cache
def _constant(values: tuple[float, ...], device: torch.device) -> Tensor:
    return torch.tensor(values, device=device)

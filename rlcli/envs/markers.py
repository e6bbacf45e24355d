"""What is drawn beside the bodies of every environment: arrows, spheres and frames, none of them part of the physics.

A command term that has a method `markers()` returns some; it is called when a viewer draws, never in a step. Places are
in the world as `entity.data.root_pos_w` is, one row an environment; where one is not finite nothing is drawn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from torch import Tensor

Color: TypeAlias = tuple[float, float, float, float]
"""Red, green, blue, opacity, each from 0 to 1."""
ASKED: Color = (0.1, 0.9, 0.1, 1.0)
"""Green: what a command asks for."""
ACTUAL: Color = (0.1, 0.3, 1.0, 1.0)
"""Blue: what there is instead."""


@dataclass(frozen=True, slots=True)
class Arrow:
    """An arrow; where it is no longer than its radius it is not drawn.

    Args:
        start: where it begins. (num_envs, 3) [m]
        end: where its tip is. (num_envs, 3) [m]
        color: of all of it.
        radius: of its shaft [m].
    """

    start: Tensor
    end: Tensor
    color: Color = ASKED
    radius: float = 0.015


@dataclass(frozen=True, slots=True)
class Sphere:
    """A sphere.

    Args:
        center: where it is. (num_envs, 3) [m]
        color: of all of it.
        radius: of it [m].
    """

    center: Tensor
    color: Color = ASKED
    radius: float = 0.02


@dataclass(frozen=True, slots=True)
class Frame:
    """The axes of a pose: x red, y green, z blue.

    Args:
        position: where it is. (num_envs, 3) [m]
        quat: its orientation (w, x, y, z), of length 1. (num_envs, 4)
        length: of each axis [m].
    """

    position: Tensor
    quat: Tensor
    length: float = 0.1


Marker: TypeAlias = Arrow | Sphere | Frame
"""One shape in every environment."""

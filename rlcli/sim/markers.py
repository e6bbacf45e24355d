"""What is drawn beside the bodies of every environment: arrows, spheres and frames, none of them part of the physics.

A command term that has a method `markers()` returns some; it is called when a viewer draws, never in a step. Places are
in the world as `entity.data.root_pos_w` is, one row an environment; where one is not finite nothing is drawn.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

from torch import Tensor

Color: TypeAlias = tuple[float, float, float, float]
"""Red, green, blue, opacity, each from 0 to 1."""
COMMANDED: Color = (0.1, 0.9, 0.1, 1.0)
"""Green: what a command asks for."""
ACTUAL: Color = (0.1, 0.3, 1.0, 1.0)
"""Blue: what there is instead."""


class Arrow(NamedTuple):
    """An arrow; where it is no longer than its radius it is not drawn."""

    start: Tensor
    """Where it begins. (num_envs, 3) [m]"""
    end: Tensor
    """Where its tip is. (num_envs, 3) [m]"""
    color: Color = COMMANDED
    radius: float = 0.015
    """Of its shaft [m]."""


class Sphere(NamedTuple):
    """A sphere."""

    center: Tensor
    """Where it is. (num_envs, 3) [m]"""
    color: Color = COMMANDED
    radius: float = 0.02
    """In metres."""


class Frame(NamedTuple):
    """The axes of a pose: x red, y green, z blue."""

    position: Tensor
    """Where it is. (num_envs, 3) [m]"""
    quat: Tensor
    """Its orientation (w, x, y, z), of length 1. (num_envs, 4)"""
    length: float = 0.1
    """Of each axis [m]."""


Marker: TypeAlias = Arrow | Sphere | Frame
"""One shape in every environment."""

"""Markers: arrows, spheres and frames that viewers show in every environment, and that are not part of the physics.

The method `markers()` of a command term returns markers; viewers call the method when they render. Positions are in the
world frame, like `entity.data.root_pos_w`, one row for each environment; a marker whose position is not finite is not
shown.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

from torch import Tensor

Color: TypeAlias = tuple[float, float, float, float]
"""Red, green, blue and opacity, each from 0 to 1."""
COMMANDED: Color = (0.1, 0.9, 0.1, 1.0)
"""Colour of markers for commanded values: green."""
ACTUAL: Color = (0.1, 0.3, 1.0, 1.0)
"""Colour of markers for actual values: blue."""


class Arrow(NamedTuple):
    """Arrow, such as a commanded velocity; it is not shown if its length is at most its radius."""

    start: Tensor
    """Start point of the arrow. (num_envs, 3) [m]"""
    end: Tensor
    """Tip of the arrow. (num_envs, 3) [m]"""
    color: Color = COMMANDED
    """Colour; the default colour marks commanded values."""
    radius: float = 0.015
    """Radius of the shaft [m]."""
    label: str = ""
    """Meaning of the marker, for the legend of viewers."""


class Sphere(NamedTuple):
    """Sphere, such as a goal position."""

    center: Tensor
    """Centre of the sphere. (num_envs, 3) [m]"""
    color: Color = COMMANDED
    """Colour; the default colour marks commanded values."""
    radius: float = 0.02
    """Radius of the sphere [m]."""
    label: str = ""
    """Meaning of the marker, for the legend of viewers."""


class Frame(NamedTuple):
    """Axes of a pose: x red, y green, z blue."""

    position: Tensor
    """Origin of the axes. (num_envs, 3) [m]"""
    quat: Tensor
    """Orientation of the axes, unit quaternion (w, x, y, z). (num_envs, 4)"""
    length: float = 0.1
    """Length of each axis [m]."""
    label: str = ""
    """Meaning of the marker, for the legend of viewers."""


Marker: TypeAlias = Arrow | Sphere | Frame
"""Shape that a viewer shows in each environment."""

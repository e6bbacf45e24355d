"""Markers in a scene of MuJoCo's: the one place where they become shapes, whatever the viewer."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli.sim.markers import Arrow, Color, Marker, Sphere
from rlcli.sim.rotations import axis_x, axis_y, axis_z

_ARROW, _SPHERE = int(mujoco.mjtGeom.mjGEOM_ARROW), int(mujoco.mjtGeom.mjGEOM_SPHERE)
_CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
_AXES: tuple[Color, ...] = ((0.9, 0.1, 0.1, 1.0), (0.1, 0.9, 0.1, 1.0), (0.1, 0.3, 1.0, 1.0))
_GLOW = 0.4
"""Light of their own, so that the colours are seen in any light."""


class _Part(NamedTuple):
    """A shape between two places, of which a sphere has but one."""

    kind: int
    start: Tensor
    end: Tensor
    radius: float
    color: Color


def add_markers(
    scene: mujoco.MjvScene, markers: Iterable[Marker], numbers: Sequence[int], offsets: NDArray[np.float64]
) -> None:
    """Append the markers of some environments, each moved by its offset, as many as the scene has room for.

    Args:
        scene: holds what else is drawn.
        markers: of all environments.
        numbers: the environments that are drawn.
        offsets: how far each of these is moved. (len(numbers), 3) [m]
    """
    for marker in markers:
        for part in _parts(marker):
            starts, ends = (_places(tensor, numbers) + offsets for tensor in (part.start, part.end))
            for start, end in zip(starts, ends, strict=True):
                if _is_seen(part, start, end) and scene.ngeom < scene.maxgeom:
                    _put(scene.geoms[scene.ngeom], part, start, end)
                    scene.ngeom += 1


def _parts(marker: Marker) -> list[_Part]:
    if isinstance(marker, Arrow):
        return [_Part(_ARROW, marker.start, marker.end, marker.radius, marker.color)]
    if isinstance(marker, Sphere):
        return [_Part(_SPHERE, marker.center, marker.center, marker.radius, marker.color)]
    tips = [marker.position + marker.length * axis(marker.quat) for axis in (axis_x, axis_y, axis_z)]
    pairs = zip(tips, _AXES, strict=True)
    return [_Part(_CYLINDER, marker.position, tip, 0.05 * marker.length, color) for tip, color in pairs]


def _places(tensor: Tensor, numbers: Sequence[int]) -> NDArray[np.float64]:
    return tensor.detach()[list(numbers)].to("cpu", torch.float64).numpy()


def _is_seen(part: _Part, start: NDArray[np.float64], end: NDArray[np.float64]) -> bool:
    length = np.linalg.norm(end - start)
    return bool(np.isfinite(length) and (part.kind == _SPHERE or length > part.radius))


def _put(geom: mujoco.MjvGeom, part: _Part, start: NDArray[np.float64], end: NDArray[np.float64]) -> None:
    mujoco.mjv_initGeom(
        geom, part.kind, np.full(3, part.radius), start, np.eye(3).ravel(), np.array(part.color, np.float32)
    )
    if part.kind != _SPHERE:
        mujoco.mjv_connector(geom, part.kind, part.radius, start, end)
    if part.kind == _ARROW:
        geom.size[2] *= 2.0  # MuJoCo's renderers draw half of it
    # left as they were by what is called above
    geom.category, geom.objtype = int(mujoco.mjtCatBit.mjCAT_DECOR), int(mujoco.mjtObj.mjOBJ_UNKNOWN)
    geom.objid, geom.segid = -1, -1
    geom.emission, geom.castshadow = _GLOW, 0

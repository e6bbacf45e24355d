"""Drawing of a task's markers (such as a sphere at a goal) as geoms of a MuJoCo scene, for viewers and videos."""

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
_EMISSION = 0.4
"""Emitted light (emission of the geom) of markers, so that their colours are visible in a dark scene."""


class _Part(NamedTuple):
    """Arrow, cylinder or sphere of a marker, in every environment."""

    kind: int
    """Geom type, `mjtGeom`."""
    start: Tensor
    """Start of the arrow or cylinder, or centre of the sphere, world frame. (num_envs, 3) [m]"""
    end: Tensor
    """End of the arrow or cylinder, or centre of the sphere, world frame. (num_envs, 3) [m]"""
    radius: float
    """[m]"""
    color: Color


def add_markers(
    scene: mujoco.MjvScene, markers: Iterable[Marker], numbers: Sequence[int], offsets: NDArray[np.float64]
) -> None:
    """Append the markers of some environments to a scene, as far as the scene has space for geoms.

    Args:
        scene: the scene, which may contain other geoms.
        markers: markers of all environments.
        numbers: indices of the environments whose markers are drawn.
        offsets: vector by which each of these environments is moved in the image. (len(numbers), 3) [m]
    """
    for marker in markers:
        for part in _parts(marker):
            starts, ends = (_points(tensor, numbers) + offsets for tensor in (part.start, part.end))
            for start, end in zip(starts, ends, strict=True):
                if _is_visible(part, start, end) and scene.ngeom < scene.maxgeom:
                    _fill_geom(scene.geoms[scene.ngeom], part, start, end)
                    scene.ngeom += 1


def _parts(marker: Marker) -> list[_Part]:
    """Return the geoms of a marker: an arrow, a sphere, or for a frame three cylinders along its axes."""
    if isinstance(marker, Arrow):
        return [_Part(_ARROW, marker.start, marker.end, marker.radius, marker.color)]
    if isinstance(marker, Sphere):
        return [_Part(_SPHERE, marker.center, marker.center, marker.radius, marker.color)]
    tips = [marker.position + marker.length * axis(marker.quat) for axis in (axis_x, axis_y, axis_z)]
    pairs = zip(tips, _AXES, strict=True)
    return [_Part(_CYLINDER, marker.position, tip, 0.05 * marker.length, color) for tip, color in pairs]


def _points(tensor: Tensor, numbers: Sequence[int]) -> NDArray[np.float64]:
    """Return the rows `numbers` of a tensor as an array. (len(numbers), 3)"""
    return tensor.detach()[list(numbers)].to("cpu", torch.float64).numpy()


def _is_visible(part: _Part, start: NDArray[np.float64], end: NDArray[np.float64]) -> bool:
    """Return whether a geom is drawn: not with NaN, and not an arrow or cylinder that is shorter than its radius."""
    length = np.linalg.norm(end - start)  # NaN hides a marker
    return bool(np.isfinite(length) and (part.kind == _SPHERE or length > part.radius))


def _fill_geom(geom: mujoco.MjvGeom, part: _Part, start: NDArray[np.float64], end: NDArray[np.float64]) -> None:
    """Set all fields of a geom of a scene to an arrow, cylinder or sphere from `start` to `end`. (3,) [m] each"""
    mujoco.mjv_initGeom(
        geom, part.kind, np.full(3, part.radius), start, np.eye(3).ravel(), np.array(part.color, np.float32)
    )
    if part.kind != _SPHERE:
        mujoco.mjv_connector(geom, part.kind, part.radius, start, end)
    if part.kind == _ARROW:
        geom.size[2] *= 2.0  # MuJoCo's renderers draw an arrow with half its length
    # the functions above do not set these fields
    geom.category, geom.objtype = int(mujoco.mjtCatBit.mjCAT_DECOR), int(mujoco.mjtObj.mjOBJ_UNKNOWN)
    geom.objid, geom.segid = -1, -1
    geom.emission, geom.castshadow = _EMISSION, 0

"""Drawing of a task's markers (arrows, frames, spheres such as goals) as geoms of a MuJoCo scene.

All viewers and videos use it.
"""

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
"""Emitted light of markers, so that their colours are visible in the dark."""


class _Part(NamedTuple):
    """Arrow, cylinder or sphere of a marker, in every environment.

    It goes from the points `start` to the points `end`, (num_envs, 3) [m] each; for a sphere both are its centre.
    """

    kind: int
    start: Tensor
    end: Tensor
    radius: float
    color: Color


def add_markers(
    scene: mujoco.MjvScene, markers: Iterable[Marker], numbers: Sequence[int], offsets: NDArray[np.float64]
) -> None:
    """Append the markers of some environments to a scene until it is full.

    Args:
        scene: the scene, which may contain other geoms.
        markers: markers of all environments.
        numbers: indices of the environments whose markers are drawn.
        offsets: displacement of each of these environments in the image from its world position. (len(numbers), 3) [m]
    """
    for marker in markers:
        for part in _parts(marker):
            starts, ends = (_points(tensor, numbers) + offsets for tensor in (part.start, part.end))
            for start, end in zip(starts, ends, strict=True):
                if _is_visible(part, start, end) and scene.ngeom < scene.maxgeom:
                    _fill_geom(scene.geoms[scene.ngeom], part, start, end)
                    scene.ngeom += 1


def _parts(marker: Marker) -> list[_Part]:
    if isinstance(marker, Arrow):
        return [_Part(_ARROW, marker.start, marker.end, marker.radius, marker.color)]
    if isinstance(marker, Sphere):
        return [_Part(_SPHERE, marker.center, marker.center, marker.radius, marker.color)]
    tips = [marker.position + marker.length * axis(marker.quat) for axis in (axis_x, axis_y, axis_z)]
    pairs = zip(tips, _AXES, strict=True)
    return [_Part(_CYLINDER, marker.position, tip, 0.05 * marker.length, color) for tip, color in pairs]


def _points(tensor: Tensor, numbers: Sequence[int]) -> NDArray[np.float64]:
    return tensor.detach()[list(numbers)].to("cpu", torch.float64).numpy()


def _is_visible(part: _Part, start: NDArray[np.float64], end: NDArray[np.float64]) -> bool:
    length = np.linalg.norm(end - start)  # NaN hides a marker
    return bool(np.isfinite(length) and (part.kind == _SPHERE or length > part.radius))


def _fill_geom(geom: mujoco.MjvGeom, part: _Part, start: NDArray[np.float64], end: NDArray[np.float64]) -> None:
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

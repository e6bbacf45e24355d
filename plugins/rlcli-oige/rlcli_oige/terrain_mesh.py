"""Terrains that a task adds as a triangle mesh: a grid of heights becomes a height field of MuJoCo."""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import numpy as np

from rlcli.errors import TaskError
from rlcli.scene.scene import Scene

if TYPE_CHECKING:
    from rlcli_oige.stage import Prim

_BASE = 1.0
"""Thickness of the ground below the lowest point [m]."""


def add_terrain(scene: Scene, prim: Prim) -> None:
    """Add the mesh of a prim to the scene.

    The mesh must be a grid: rows of x, columns of y, two triangles for each cell. A vertex may be up to one cell away
    from its place on the grid, as in meshes in which vertical walls replace steep slopes. The height field has the
    slope.

    Raises:
        TaskError: for another mesh.
    """
    points = _value(prim, "points")
    faces = _value(prim, "faceVertexIndices")
    if points is None or faces is None:
        return
    points, faces = np.asarray(points, dtype=float).reshape(-1, 3), np.asarray(faces).reshape(-1)
    columns = int(np.max(faces[:6])) - 1
    grid = None if columns < 2 or len(points) % columns else points.reshape(-1, columns, 3)
    if grid is not None:
        x, y = grid[..., 0], grid[..., 1]
        ideal_x = np.linspace(x.min(), x.max(), grid.shape[0])[:, None]
        ideal_y = np.linspace(y.min(), y.max(), columns)[None, :]
        cell = max(ideal_x[1, 0] - ideal_x[0, 0], ideal_y[0, 1] - ideal_y[0, 0]) * 1.001
        if (np.abs(x - ideal_x) > cell).any() or (np.abs(y - ideal_y) > cell).any():
            grid = None
    if grid is None:
        raise TaskError(
            f"the mesh '{prim.prim_path}' is not a grid of heights, and MuJoCo's meshes are convex",
            hint="use scene.terrain, or add the mesh to an MJCF as convex parts",
        )
    heights = grid[..., 2].T  # MuJoCo's rows are y, its columns are x
    low, high = float(heights.min()), float(heights.max())
    half_x, half_y = 0.5 * np.ptp(grid[..., 0]), 0.5 * np.ptp(grid[..., 1])
    span = max(high - low, 1e-3)
    scene.spec.add_hfield(
        name="terrain", nrow=heights.shape[0], ncol=heights.shape[1], size=[half_x, half_y, span, _BASE],
        userdata=((heights - low) / span).astype(np.float32).reshape(-1),
    )  # fmt: skip
    center = np.array([grid[..., 0].min() + half_x, grid[..., 1].min() + half_y, low])
    scene.spec.worldbody.add_geom(
        name="terrain", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="terrain", pos=center + np.asarray(prim.pos),
        quat=prim.quat, friction=[1.0, 0.005, 0.0001], priority=1,
    )  # fmt: skip
    if np.abs(x - ideal_x).max() > 1e-3 or np.abs(y - ideal_y).max() > 1e-3:
        prim.stage.note_ignored(
            f"vertical walls of {prim.prim_path}", "the height field has slopes that are one cell wide", lost=True
        )


def _value(prim: Prim, name: str) -> object:
    attribute = prim.attributes.get(("", "", name))
    return None if attribute is None else attribute.value

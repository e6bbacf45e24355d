"""Replacement for USD geometry, for tasks that read the shapes of objects.

Every collision geom of an entity is a prim with a triangle mesh.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from rlcli.errors import TaskError, listing
from rlcli_isaaclab.direct_env import MANAGED
from rlcli_isaaclab.usd_stage import Prim
from rlcli_isaaclab.usd_stage import UsdGeom as _Poses

_SEGMENTS = 16
"""Number of segments by which a circle is approximated in triangle meshes."""


class Matrix:
    """Pose as a 4 x 4 matrix M in the convention of USD: a point is a row vector p = (x, y, z, 1) and moves to p M."""

    def __init__(self, values: NDArray[np.float64]) -> None:
        self._values = values

    def __getitem__(self, row: int) -> NDArray[np.float64]:
        found: NDArray[np.float64] = self._values[row]
        return found

    def __mul__(self, other: Matrix) -> Matrix:
        return Matrix(self._values @ other._values)

    def GetInverse(self) -> Matrix:  # noqa: N802
        """Return the inverse pose."""
        inverse = np.linalg.inv(self._values).astype(np.float64)
        return Matrix(inverse)


class GeomPrim(Prim):
    """Prim of a geom, or of the root of an entity (`geom` = -1).

    Args:
        path: prim path.
        model: the model.
        body: index of the entity's root body.
        geom: index of the geom, or -1.
    """

    def __init__(self, path: str, model: mujoco.MjModel, body: int, geom: int) -> None:
        super().__init__(path)
        self.model, self.body, self.geom = model, body, geom

    def GetTypeName(self) -> str:  # noqa: N802
        """Return "Mesh" for a geom, "Xform" for the root of an entity."""
        return "Mesh" if self.geom >= 0 else "Xform"

    def GetAttribute(self, name: str) -> None:  # noqa: N802
        """Return None, as USD does for an attribute that a prim lacks: a geom has no attributes such as a scale."""

    def in_root(self) -> NDArray[np.float64]:
        """Return the pose of the geom in the frame of the entity's root. (4, 4), for column vectors"""
        pose = np.eye(4)
        if self.geom < 0:
            return pose
        model, body = self.model, int(self.model.geom_bodyid[self.geom])
        pose = _pose(model.geom_pos[self.geom], model.geom_quat[self.geom])
        while body != self.body:
            pose = _pose(model.body_pos[body], model.body_quat[body]) @ pose
            body = int(model.body_parentid[body])
        return pose


def _pose(position: Any, quat: Any) -> NDArray[np.float64]:
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, quat)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.reshape(3, 3), position
    return pose


def prims_below(path: str) -> list[GeomPrim]:
    """Return the prim of the entity with a prim path, followed by the prims of its collision geoms.

    Raises:
        TaskError: if no entity has the path.
    """
    managed = MANAGED.get()
    name = path.rstrip("/").rsplit("/", 1)[-1].lower()
    entity = managed.entities.get(name)
    if entity is None:
        hint = f"the last part of the path must be the name of an entity: {listing(managed.entities)}"
        raise TaskError(f"the prim {path} does not exist: the scene has no entity '{name}'", hint=hint)
    model = managed.engine.model
    bodies = [int(body) for body in entity.body_ids]
    shapes = [
        g for g in range(model.ngeom)
        if int(model.geom_bodyid[g]) in bodies and (model.geom_contype[g] or model.geom_conaffinity[g])
    ]  # fmt: skip
    return [GeomPrim(path, model, bodies[0], geom) for geom in (-1, *shapes)]


def get_all_matching_child_prims(prim_path: Any, predicate: Any = lambda prim: True, **options: Any) -> list[GeomPrim]:
    """Return the prims below a prim path for which `predicate` returns True."""
    return [prim for prim in prims_below(str(prim_path)) if predicate(prim)]


class _Mesh:
    """Triangle mesh of a geom with the methods of `pxr.UsdGeom.Mesh`."""

    def __init__(self, prim: GeomPrim) -> None:
        self._points, self._faces = _triangles(prim.model, prim.geom)

    def GetPointsAttr(self) -> Any:  # noqa: N802
        """Return an object whose `Get()` returns the vertices in the geom's frame. (n, 3) [m]"""
        return SimpleNamespace(Get=lambda: self._points)

    def GetFaceVertexCountsAttr(self) -> Any:  # noqa: N802
        """Return an object whose `Get()` returns the number of corners of each face, which is 3."""
        return SimpleNamespace(Get=lambda: [3] * len(self._faces))

    def GetFaceVertexIndicesAttr(self) -> Any:  # noqa: N802
        """Return an object whose `Get()` returns the indices of the corners of all faces, as one list."""
        return SimpleNamespace(Get=lambda: self._faces.reshape(-1).tolist())


def _triangles(model: mujoco.MjModel, geom: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return the vertices of a geom in its own frame (n, 3) [m], and its faces (m, 3), indices of vertices.

    Raises:
        TaskError: for a geom of another type, such as a plane.
    """
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
        start, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
        return model.mesh_vert[first : first + count].copy(), model.mesh_face[start : start + faces].astype(np.int64)
    if kind == types.mjGEOM_BOX:
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size
        sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        return corners.astype(np.float32), np.array([(a, b, c) for s in sides for a, b, c in (s[:3], (s[0], *s[2:]))])
    if kind in (types.mjGEOM_SPHERE, types.mjGEOM_ELLIPSOID, types.mjGEOM_CAPSULE, types.mjGEOM_CYLINDER):
        return _revolved(*_profile(kind, size))
    hint = "use a box, a sphere, an ellipsoid, a capsule, a cylinder or a mesh"
    raise TaskError(f"a geom of type {types(kind).name} cannot be converted to triangles", hint=hint)


def _profile(kind: int, size: Any) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the outline of a shape of revolution, and the scale of its axes.

    Returns:
        Points (radius, height) from bottom to top, (n, 2) [m], and factors for x, y and z, (3,).
    """
    types = mujoco.mjtGeom
    if kind == types.mjGEOM_CYLINDER:
        return np.array([(0, -size[1]), (size[0], -size[1]), (size[0], size[1]), (0, size[1])]), np.ones(3)
    angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, _SEGMENTS // 2 + 1)
    outline = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    if kind == types.mjGEOM_ELLIPSOID:
        return outline, np.asarray(size)
    outline *= size[0]
    if kind == types.mjGEOM_CAPSULE:
        lower, upper = outline[angles <= 0.0] - [0, size[1]], outline[angles >= 0.0] + [0, size[1]]
        outline = np.concatenate([lower, upper])
    return outline, np.ones(3)


def _revolved(outline: Any, scale: Any) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    turn = np.linspace(0.0, 2.0 * np.pi, _SEGMENTS, endpoint=False)
    rings = [np.stack([r * np.cos(turn), r * np.sin(turn), np.full_like(turn, h)], axis=1) for r, h in outline]
    faces = []
    for ring in range(len(rings) - 1):
        for i in range(_SEGMENTS):
            a, b = ring * _SEGMENTS + i, ring * _SEGMENTS + (i + 1) % _SEGMENTS
            faces += [(a, b, b + _SEGMENTS), (a, b + _SEGMENTS, a + _SEGMENTS)]
    return (np.concatenate(rings) * scale).astype(np.float32), np.array(faces)


class _XformCache:
    def GetLocalToWorldTransform(self, prim: Any) -> Matrix:  # noqa: N802
        """Return the pose of a prim in the frame of its entity's root."""
        return Matrix(prim.in_root().T)


UsdGeom = SimpleNamespace(**vars(_Poses), XformCache=_XformCache, Mesh=_Mesh)

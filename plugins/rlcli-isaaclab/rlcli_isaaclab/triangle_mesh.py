"""Replacement for the library `trimesh` if it is not installed, for tasks that sample points on surfaces."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rlcli.errors import pip_install
from rlcli_isaaclab.missing_names import absence


class Trimesh:
    """Triangle mesh: vertices (n, 3) [m], and faces (m, 3), each with the indices of its three vertices."""

    def __init__(self, vertices: Any, faces: Any, process: bool = False) -> None:
        self.vertices, self.faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)

    @property
    def triangles(self) -> NDArray[np.float64]:
        """Corners of each face. (m, 3, 3) [m]"""
        corners: NDArray[np.float64] = self.vertices[self.faces]
        return corners

    @property
    def area_faces(self) -> NDArray[np.float64]:
        """Area of each face. (m,) [m^2]"""
        a, b, c = self.triangles.transpose(1, 0, 2)
        areas: NDArray[np.float64] = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        return areas

    @property
    def area(self) -> float:
        """Area of all faces [m^2]."""
        return float(self.area_faces.sum())

    @property
    def volume(self) -> float:
        """Enclosed volume [m^3], positive if the corners of each face run anticlockwise, seen from outside."""
        a, b, c = self.triangles.transpose(1, 0, 2)
        return float((a * np.cross(b, c)).sum() / 6.0)

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Smallest and largest coordinates. (2, 3) [m]"""
        limits: NDArray[np.float64] = np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])
        return limits

    @property
    def extents(self) -> NDArray[np.float64]:
        """Size along each axis. (3,) [m]"""
        low, high = self.bounds
        size: NDArray[np.float64] = high - low
        return size

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise absence(f"trimesh.Trimesh.{name}", hint=pip_install("trimesh"))


def sample_surface(mesh: Any, count: int, face_weight: Any = None, seed: Any = None) -> tuple[Any, Any]:
    """Return random points on the surface of a mesh (count, 3) [m], and the index of each point's face (count,).

    The probability of a face is proportional to its area, or to `face_weight`.
    """
    draws = np.random.default_rng(seed if seed is not None else np.random.randint(2**31))
    weight = mesh.area_faces if face_weight is None else np.asarray(face_weight)
    faces = draws.choice(len(weight), size=count, p=weight / weight.sum())
    a, b, c = mesh.triangles[faces].transpose(1, 0, 2)
    u, v = draws.random((2, count, 1))
    flip = u + v > 1.0
    u, v = np.where(flip, 1.0 - u, u), np.where(flip, 1.0 - v, v)
    return a + u * (b - a) + v * (c - a), faces


sample = SimpleNamespace(sample_surface=sample_surface)


def __getattr__(name: str) -> Any:
    if name.startswith("__"):
        raise AttributeError(name)
    raise absence(f"trimesh.{name}", hint=pip_install("trimesh"))

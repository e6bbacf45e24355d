"""Rays of the GPU engine."""

from __future__ import annotations

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp
from torch import Tensor

_Groups = wp.types.vector(length=mujoco.mjNGROUP, dtype=float)


class RayCaster:
    """Casts rays in all worlds; called where Warp launches on their device.

    Args:
        model: on the device.
        data: the worlds.
        num_envs: worlds.
    """

    def __init__(self, model: mjw.Model, data: mjw.Data, num_envs: int) -> None:
        self._model, self._data, self._num_envs = model, data, num_envs
        self._buffers: dict[tuple[int, int], tuple[wp.array, wp.array, wp.array]] = {}

    def cast(self, points: Tensor, directions: Tensor, groups: tuple[int, ...] | None, exclude: int) -> Tensor:
        """Return distances to the first geom, -1 for none. (num_envs, rays)"""
        shape = (self._num_envs, points.shape[1])
        distance = torch.empty(shape, device=points.device)
        excluded, geom, normal = self._buffers_for(shape, exclude)
        seen = _Groups(*(-1.0 if groups is None else float(g in groups) for g in range(mujoco.mjNGROUP)))
        pnt, vec = (wp.from_torch(v.expand(*shape, 3).contiguous(), dtype=wp.vec3) for v in (points, directions))
        mjw.rays(
            self._model, self._data, pnt, vec, seen, True, excluded, wp.from_torch(distance), geom, normal
        )  # fmt: skip
        return distance

    def _buffers_for(self, shape: tuple[int, int], exclude: int) -> tuple[wp.array, wp.array, wp.array]:
        """Return the body that each ray ignores, and room for the geoms and normals that are hit."""
        _, rays = shape
        if (rays, exclude) not in self._buffers:
            self._buffers[rays, exclude] = (
                wp.full(rays, exclude, dtype=int),
                wp.empty(shape, dtype=int),
                wp.empty(shape, dtype=wp.vec3),
            )
        return self._buffers[rays, exclude]

"""Ray casts of the GPU engine."""

from __future__ import annotations

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp
from torch import Tensor

from rlcli.sim.selection import Groups

_GroupFlags = wp.types.vector(length=mujoco.mjNGROUP, dtype=float)


class RayCaster:
    """Caster of rays in all worlds, whose device must be Warp's current device.

    Args:
        model: the model on the device.
        data: the worlds on the device.
        num_envs: number of worlds.
    """

    def __init__(self, model: mjw.Model, data: mjw.Data, num_envs: int) -> None:
        self._model, self._data, self._num_envs = model, data, num_envs
        self._buffers: dict[tuple[int, int], tuple[wp.array, wp.array, wp.array]] = {}

    def cast(self, points: Tensor, directions: Tensor, groups: Groups, exclude: int) -> Tensor:
        """Return distances to the first geom, -1 for none. (num_envs, rays) [m]"""
        shape = (self._num_envs, points.shape[1])
        distance = torch.empty(shape, device=points.device)
        excluded, geom, normal = self._buffers_for(shape, exclude)
        visible = _GroupFlags(*(-1.0 if groups is None else float(g in groups) for g in range(mujoco.mjNGROUP)))
        pnt, vec = (wp.from_torch(v.expand(*shape, 3).contiguous(), dtype=wp.vec3) for v in (points, directions))
        out = wp.from_torch(distance)
        mjw.rays(self._model, self._data, pnt, vec, visible, True, excluded, out, geom, normal)
        return distance

    def _buffers_for(self, shape: tuple[int, int], exclude: int) -> tuple[wp.array, wp.array, wp.array]:
        """Return the excluded body of each ray, and buffers for the geoms and normals at the hits."""
        _, rays = shape
        if (rays, exclude) not in self._buffers:
            bodies, geoms = wp.full(rays, exclude, dtype=int), wp.empty(shape, dtype=int)
            self._buffers[rays, exclude] = bodies, geoms, wp.empty(shape, dtype=wp.vec3)
        return self._buffers[rays, exclude]

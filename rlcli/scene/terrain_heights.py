"""Height of the ground below points, looked up in the heights of a terrain."""

from __future__ import annotations

import torch
from torch import Tensor

from rlcli.scene.terrain import Ground


class HeightTable:
    """Heights of a terrain without boxes; each cell has two triangles, as in MuJoCo's height fields."""

    def __init__(self, ground: Ground, device: torch.device) -> None:
        self._nx, self._ny = ground.heights.shape
        self._heights = torch.tensor(ground.heights, dtype=torch.float32, device=device).flatten()
        self._resolution = ground.resolution
        self._half = [0.5 * (n - 1) * ground.resolution for n in ground.heights.shape]
        self._border = ground.border

    def distance(self, points: Tensor) -> Tensor:
        """Return the distance from each point down to the ground; -1 if no ground is below. (..., 3) -> (...) [m]"""
        px, py, pz = points.unbind(-1)
        half_x, half_y = self._half
        x, y = (px + half_x) / self._resolution, (py + half_y) / self._resolution
        i, j = x.floor().clamp_(0, self._nx - 2), y.floor().clamp_(0, self._ny - 2)
        u, v = x - i, y - j
        corner = i.long() * self._ny + j.long()
        low, ahead, left, both = (self._heights.take(corner + step) for step in (0, self._ny, 1, self._ny + 1))
        # the diagonal of a cell runs from `low` to `both`
        rise = torch.where(u >= v, u * (ahead - low) + v * (both - ahead), v * (left - low) + u * (both - left))
        on_field = (px.abs() <= half_x) & (py.abs() <= half_y)
        on_ground = (px.abs() <= half_x + self._border) & (py.abs() <= half_y + self._border)
        depth = pz - torch.where(on_field, low + rise, 0.0)
        return torch.where(on_ground & (depth >= 0.0), depth, -1.0)

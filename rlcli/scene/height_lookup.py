"""Table of terrain heights, from which ray sensors with `lookup: true` read distances instead of casting rays."""

from __future__ import annotations

import torch
from torch import Tensor

from rlcli.scene.terrain import Ground


class HeightTable:
    """Heights of a terrain without boxes, interpolated on two triangles per cell, as MuJoCo's height fields are."""

    def __init__(self, ground: Ground, device: torch.device) -> None:
        self._nx, self._ny = ground.heights.shape
        self._heights = torch.tensor(ground.heights, dtype=torch.float32, device=device).flatten()
        self._resolution = ground.resolution
        self._half = [0.5 * (n - 1) * ground.resolution for n in ground.heights.shape]
        self._border = ground.border

    def depth(self, px: Tensor, py: Tensor, pz: Tensor) -> tuple[Tensor, Tensor]:
        """Return the heights of points above the ground [m], and whether there is ground at each point. (...) each

        px, py and pz are the coordinates of the points, world frame [m].
        """
        half_x, half_y = self._half
        x, y = (px + half_x).div_(self._resolution), (py + half_y).div_(self._resolution)
        i, j = x.floor().clamp_(0, self._nx - 2), y.floor().clamp_(0, self._ny - 2)
        u, v = x.sub_(i), y.sub_(j)
        corner = torch.add(j.long(), i.long(), alpha=self._ny)
        low, ahead, left, both = (self._heights.take(corner + step) for step in (0, self._ny, 1, self._ny + 1))
        # the diagonal of a cell runs from `low` to `both`: u runs along one of the two other sides, v along the other
        first = u >= v
        along = torch.where(first, ahead - low, both - left)
        across = torch.where(first, both - ahead, left - low)
        ground = u.mul_(along).add_(v.mul_(across)).add_(low)
        far_x, far_y = px.abs(), py.abs()
        ground.masked_fill_(((far_x <= half_x) & (far_y <= half_y)).logical_not_(), 0.0)
        on_ground = (far_x <= half_x + self._border) & (far_y <= half_y + self._border)
        return torch.sub(pz, ground), on_ground

"""Column indices that select a view wherever possible, and a cache of such views."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli.sim.selection import Columns

MAX_CACHED_VIEWS = 256
"""Indices of which an entity's views are kept: those of a configuration are few."""


def as_index(positions: Sequence[int], device: torch.device | None = None) -> Columns:
    """Column positions as a slice where they are consecutive (a view, not a copy), else as a tensor."""
    first = positions[0] if len(positions) else 0
    if list(positions) == list(range(first, first + len(positions))):
        return _consecutive(first, first + len(positions))
    return torch.tensor(list(positions), dtype=torch.int64, device=device)


@functools.lru_cache(maxsize=4096)
def _consecutive(first: int, stop: int) -> slice:
    """One object for all who ask, so that what they read of it is made once for all."""
    return slice(first, stop)


def id_tensor(ids: NDArray[np.integer[Any]], device: torch.device) -> Tensor:
    """Return ids of MuJoCo as a tensor that indexes others."""
    return torch.from_numpy(ids.astype(np.int64)).to(device)


class CachedViews:
    """Cache of `values[:, joints]`: the same tensor and the same slice give the same view object."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Columns, Tensor, Tensor]] = {}

    def of(self, values: Tensor, joints: Columns) -> Tensor:
        """`values[:, joints]`."""
        known = self._known.get(id(joints))
        if known is not None and known[0] is joints and known[1] is values:
            return known[2]
        part = values[:, joints]
        if isinstance(joints, slice):  # what another index gives is a copy
            if len(self._known) >= MAX_CACHED_VIEWS:
                self._known.clear()
            # the index stays referenced, so that its id is not given to another
            self._known[id(joints)] = joints, values, part
        return part

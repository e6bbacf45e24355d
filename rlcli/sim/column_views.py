"""Convert the positions of columns (such as those of some joints) to an index into a tensor, and cache views.

The index is a slice where possible, because indexing with a slice gives a view instead of a copy.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli.sim.env_selection import Columns

MAX_CACHED_VIEWS = 256
"""Largest number of cached views; the terms of a configuration need far fewer."""


def as_index(positions: Sequence[int], device: torch.device | None = None) -> Columns:
    """Return column positions as a slice if they are consecutive (a view, not a copy), else as a tensor."""
    first = positions[0] if len(positions) else 0
    if list(positions) == list(range(first, first + len(positions))):
        return _consecutive(first, first + len(positions))
    return torch.tensor(list(positions), dtype=torch.int64, device=device)


def evenly_spaced(positions: Sequence[int], device: torch.device | None = None) -> Columns:
    """Return column positions as a slice if they ascend in equal steps, else as a tensor.

    If all positions are the same column, the slice selects this column once, for broadcasting.
    """
    steps = {after - before for before, after in itertools.pairwise(positions)} or {1}
    if len(positions) and len(steps) == 1 and min(steps) >= 0:
        return slice(positions[0], positions[-1] + 1, min(steps) or 1)
    return torch.tensor(list(positions), dtype=torch.int64, device=device)


@functools.lru_cache(maxsize=4096)
def _consecutive(first: int, stop: int) -> slice:
    """Return a slice, the same object for equal arguments: `CachedViews` caches one view for each slice object."""
    return slice(first, stop)


def id_tensor(ids: NDArray[np.integer[Any]], device: torch.device) -> Tensor:
    """Return ids of bodies, joints, ... in MuJoCo's model as a tensor for indexing. int64"""
    return torch.from_numpy(ids.astype(np.int64)).to(device)


class CachedViews:
    """Cache of `values[:, joints]`: the same tensor and the same slice object give the same view object."""

    def __init__(self) -> None:
        self._views: dict[int, tuple[Columns, Tensor, Tensor]] = {}

    def of(self, values: Tensor, joints: Columns) -> Tensor:
        """Return `values[:, joints]`; if `joints` is a slice, the view is made at the first call and cached."""
        cached = self._views.get(id(joints))
        if cached is not None and cached[0] is joints and cached[1] is values:
            return cached[2]
        part = values[:, joints]
        if isinstance(joints, slice):  # a tensor index gives a copy, which must not be cached
            if len(self._views) >= MAX_CACHED_VIEWS:
                self._views.clear()
            # the cache keeps the index alive: Python may give the id of a deleted object to a new one
            self._views[id(joints)] = joints, values, part
        return part

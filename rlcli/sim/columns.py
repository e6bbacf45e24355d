"""Some columns of a tensor: an index that gives a view wherever it can, and views that are made once."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import torch
from torch import Tensor

from rlcli.sim.selection import Columns

MOST_PARTS = 256
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


class Parts:
    """`values[:, joints]` of what is read in every step: of the same tensor and the same slice, the same view."""

    def __init__(self) -> None:
        self._known: dict[int, tuple[Columns, Tensor, Tensor]] = {}

    def of(self, values: Tensor, joints: Columns) -> Tensor:
        """`values[:, joints]`."""
        known = self._known.get(id(joints))
        if known is not None and known[0] is joints and known[1] is values:
            return known[2]
        part = values[:, joints]
        if isinstance(joints, slice):  # what another index gives is a copy
            if len(self._known) >= MOST_PARTS:
                self._known.clear()
            # the index stays referenced, so that its id is not given to another
            self._known[id(joints)] = joints, values, part
        return part

"""Ranges of numbers as tensors; those that a curriculum moves are tensors already, and are read when they are used."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TypeAlias

import torch
from torch import Tensor

Pair: TypeAlias = Sequence[float] | Tensor
"""A range at run time: two numbers, or the tensor (2,) that a curriculum writes to."""


class Ranges:
    """The lower and the upper ends of several ranges."""

    def __init__(self, device: torch.device, *pairs: Pair) -> None:
        fixed = [(0.0, 0.0) if isinstance(pair, Tensor) else tuple(pair) for pair in pairs]
        self._fixed = torch.tensor(fixed, dtype=torch.float32, device=device)
        self._live = [pair if isinstance(pair, Tensor) else None for pair in pairs]
        self._any_live = any(pair is not None for pair in self._live)

    def now(self) -> tuple[Tensor, Tensor]:
        """The ends as they are at the moment. (ranges,) float32 each"""
        ends = self._fixed
        if self._any_live:
            rows = zip(self._fixed, self._live, strict=True)
            ends = torch.stack([row if live is None else live for row, live in rows])
        return ends[:, 0], ends[:, 1]


@functools.lru_cache(maxsize=1024)
def ranges(device: torch.device, *pairs: Pair) -> Ranges:
    """The same object for the same ranges, for terms that are functions."""
    return Ranges(device, *pairs)

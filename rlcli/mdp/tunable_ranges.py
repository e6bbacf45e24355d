"""Ranges as tensors: fixed ranges are converted once, those that a curriculum changes are read at each use."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TypeAlias

import torch
from torch import Tensor

Pair: TypeAlias = Sequence[float] | Tensor
"""A range at run time: two numbers, or the tensor (2,) that a curriculum writes to."""


class Ranges:
    """Lower and upper ends of several ranges."""

    def __init__(self, device: torch.device, *pairs: Pair) -> None:
        self._fixed = _table(device, *((0.0, 0.0) if isinstance(pair, Tensor) else tuple(pair) for pair in pairs))
        self._tunable = [pair if isinstance(pair, Tensor) else None for pair in pairs]
        self._any_tunable = any(pair is not None for pair in self._tunable)

    def now(self) -> tuple[Tensor, Tensor]:
        """Return the current ends. (ranges,) float32 each"""
        ends = self._fixed
        if self._any_tunable:
            rows = zip(self._fixed, self._tunable, strict=True)
            ends = torch.stack([row if tunable is None else tunable for row, tunable in rows])
        return ends[:, 0], ends[:, 1]


@functools.lru_cache(maxsize=1024)
def _table(device: torch.device, *pairs: tuple[float, float]) -> Tensor:
    """Return the range ends on the device; cached, as a captured step must not make new tensors. (ranges, 2)"""
    return torch.tensor(pairs, dtype=torch.float32, device=device)

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
        self._fixed = _table(device, *((0.0, 0.0) if isinstance(pair, Tensor) else tuple(pair) for pair in pairs))
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
def _table(device: torch.device, *pairs: tuple[float, float]) -> Tensor:
    """The numbers on the device, made once: a step that is recorded must not make tensors of numbers. (ranges, 2)"""
    return torch.tensor(pairs, dtype=torch.float32, device=device)

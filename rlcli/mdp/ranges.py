"""Ranges of which an end may follow a schedule, as tensors of the moment."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TypeAlias

import torch
from torch import Tensor

from rlcli.config.schema import Schedule

Pair: TypeAlias = Sequence[float | Schedule] | Tensor
"""What a parameter annotated `ScheduledRange` or `ScheduledPair` is at run time: two numbers, or schedules; the two
numbers are in a tensor if a curriculum moves them."""


class Ranges:
    """The lower and the upper ends of several ranges, at a step that the device alone may know."""

    def __init__(self, device: torch.device, *pairs: Pair) -> None:
        self._live = [pair if isinstance(pair, Tensor) else None for pair in pairs]
        self._any_live = any(pair is not None for pair in self._live)
        ends = [[0.0 if isinstance(pair, Tensor) else pair[end] for pair in pairs] for end in (0, 1)]
        self._fixed = None
        before = [[end.begin if isinstance(end, Schedule) else end for end in row] for row in ends]
        if not any(isinstance(end, Schedule) for row in ends for end in row):
            self._fixed = torch.tensor(before, dtype=torch.float32, device=device)
            return
        after = [[end.end if isinstance(end, Schedule) else end for end in row] for row in ends]
        first = [[end.first if isinstance(end, Schedule) else 0 for end in row] for row in ends]
        last = [[end.last if isinstance(end, Schedule) else 1 for end in row] for row in ends]
        self._before, self._after, self._first, last_step = (
            torch.tensor(values, dtype=torch.float64, device=device) for values in (before, after, first, last)
        )
        self._length = last_step - self._first

    def at(self, step: Tensor) -> tuple[Tensor, Tensor]:
        """The ends at a step since the start of the training, () int64. (ranges,) float32 each"""
        now = self._scheduled(step)
        if self._any_live:
            rows = zip(now.unbind(1), self._live, strict=True)
            now = torch.stack([row if live is None else live for row, live in rows], dim=1)
        return now[0], now[1]

    def _scheduled(self, step: Tensor) -> Tensor:
        if self._fixed is not None:
            return self._fixed
        progress = ((step - self._first) / self._length).clamp_(0.0, 1.0)
        return (self._before * (1.0 - progress) + self._after * progress).float()


@functools.lru_cache(maxsize=1024)
def ranges(device: torch.device, *pairs: Pair) -> Ranges:
    """The same object for the same ranges, for terms that are functions."""
    return Ranges(device, *pairs)

"""A selection as a mask over all environments: a GPU uses it without a host sync."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from rlcli import random
from rlcli.sim import warp_kernels
from rlcli.sim.selection import ALL, Columns


class MaskSelection:
    """Every row takes part in the arithmetic; only masked ones are written. Draws are those of `IdSelection`."""

    def __init__(
        self, mask: Tensor, seed: int, counters: Tensor, stream: np.uint64 | None = None, shared_streams: int = 0
    ) -> None:
        self.mask = mask
        self._shared_streams = shared_streams
        self._seed = seed
        self._counters = counters
        self._stream = np.uint64(0) if stream is None else stream
        self._drawn = 0

    @property
    def count(self) -> Tensor:
        """How many environments are selected. ()"""
        return self.mask.sum()

    def uniform(self, low: float | Tensor, high: float | Tensor, shape: tuple[int, ...] = ()) -> Tensor:
        """Uniform in [low, high). (num_envs, *shape)"""
        if isinstance(low, Tensor):
            return torch.addcmul(low, self._uniform(0.0, 1.0, shape), high - low)
        if isinstance(high, Tensor):
            return self._uniform(0.0, 1.0, shape).mul_(high - low).add_(low)
        return self._uniform(low, high, shape)

    def normal(self, mean: float | Tensor, std: float | Tensor, shape: tuple[int, ...] = ()) -> Tensor:
        """Gaussian. (num_envs, *shape)"""
        out, index = self._allocate(shape, 2)
        inputs = [self._start(), self._counter_array(), int(self._stream), index, self._num_streams()]
        self._launch(warp_kernels.draw_normal, inputs, out)
        return out.view(len(self.mask), *shape).mul_(std).add_(mean)

    def choice(self, options: int, shape: tuple[int, ...] = ()) -> Tensor:
        """Whole numbers in [0, options), each as likely. (num_envs, *shape)"""
        return self._uniform(0.0, 1.0, shape).double().mul_(options).long()

    def read(self, field: Tensor, columns: Columns = ALL) -> Tensor:
        """All rows of a (num_envs, ...) tensor, copied."""
        return field.clone() if columns is ALL else field[:, columns].clone()

    def read_view(self, field: Tensor, columns: Columns = ALL) -> Tensor:
        """All rows of a (num_envs, ...) tensor, where possible the tensor itself."""
        return field if columns is ALL else field[:, columns]

    def write(self, field: Tensor, values: Tensor | float, columns: Columns = ALL) -> None:
        """Set the masked rows of a (num_envs, ...) tensor."""
        if isinstance(columns, Tensor):
            part = field[:, columns]
            self.write(part, values)
            field[:, columns] = part
            return
        part = field if columns is ALL else field[:, columns]
        mask = self.mask.view(-1, *[1] * (part.dim() - 1))
        if isinstance(values, Tensor):
            torch.where(mask, values.to(part.dtype), part, out=part)
        else:
            part.masked_fill_(mask, values)

    def add(self, field: Tensor, values: Tensor | float, columns: Columns = ALL) -> None:
        """Add to the masked rows of a (num_envs, ...) tensor."""
        part = field if columns is ALL else field[:, columns]
        self.write(field, part + values, columns)

    def mean(self, values: Tensor) -> Tensor:
        """Mean of a (num_envs,) tensor over the masked rows. ()"""
        return torch.where(self.mask, values.float(), 0.0).sum() / self.count.clamp(min=1)

    def where(self, mask: Tensor) -> MaskSelection:
        """Those of the rows where `mask` (num_envs,) holds."""
        return MaskSelection(self.mask & mask, self._seed, self._counters, self._stream, self._shared_streams)

    def env_ids(self) -> Tensor:
        """The masked rows' numbers; waits for the device. (rows,) int64"""
        return self.mask.nonzero()[:, 0]

    def union(self, other: MaskSelection) -> MaskSelection:
        """The rows that are in either."""
        return MaskSelection(self.mask | other.mask, self._seed, self._counters, shared_streams=self._shared_streams)

    def stream(self, stream: np.uint64) -> MaskSelection:
        """The same rows drawing from another stream."""
        return MaskSelection(self.mask, self._seed, self._counters, stream, self._shared_streams)

    def _uniform(self, low: float, high: float, shape: tuple[int, ...]) -> Tensor:
        out, index = self._allocate(shape, 1)
        inputs = [self._start(), self._counter_array(), int(self._stream), index, self._num_streams(), low, high - low]
        self._launch(warp_kernels.draw_uniform, inputs, out)
        return out.view(len(self.mask), *shape)

    def _allocate(self, shape: tuple[int, ...], words: int) -> tuple[Tensor, int]:
        """Return a (num_envs, count) tensor for a draw, and the index of its first random word."""
        count = math.prod(shape)
        index, self._drawn = self._drawn, self._drawn + words * count
        return torch.empty(len(self.mask), count, device=self.mask.device), index

    def _num_streams(self) -> int:
        """Return how many random streams there are: one for each environment, unless environments share some."""
        return self._shared_streams or len(self.mask)

    def _start(self) -> int:
        return int(random.start(self._seed)[0])

    def _counter_array(self) -> wp.array:
        return wp.from_torch(self._counters.contiguous())

    def _launch(self, kernel: wp.Kernel, inputs: list[Any], out: Tensor) -> None:
        if out.shape[1]:
            wp.launch(kernel, tuple(out.shape), inputs, [wp.from_torch(out)], device=wp.device_from_torch(out.device))

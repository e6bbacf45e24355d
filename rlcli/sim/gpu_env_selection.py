"""Class `MaskSelection`: a subset of the environments as a mask, for the GPU engine.

A mask needs no host sync: a list of indices would, because the CPU must know its length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
import warp as wp
from torch import Tensor

from rlcli import random
from rlcli.sim import warp_kernels
from rlcli.sim.env_selection import ALL, DEFAULT_STREAM, Columns


@dataclass(eq=False)
class MaskSelection:
    """Selection of the environments where a mask is true, for a GPU.

    Operations compute the rows of all environments; only the rows where the mask is true are written. The random
    numbers equal those of `IdSelection`.

    Args:
        mask: the selected environments. (num_envs,) bool
        seed: seed of the random numbers.
        counters: index of each environment's random sequence, usually its episode. (num_envs,)
        stream_key: key of the purpose of the random numbers (for example a term), a result of `rlcli.random.stream`.
        shared_streams: environments i and i % shared_streams draw the same random numbers; 0: every environment has
            its own stream.
    """

    mask: Tensor
    seed: int
    counters: Tensor
    stream_key: np.uint64 = DEFAULT_STREAM
    shared_streams: int = 0
    _drawn: int = field(default=0, init=False)

    @property
    def count(self) -> Tensor:
        """Number of selected environments. (scalar)"""
        return self.mask.sum()

    def uniform(self, low: float | Tensor, high: float | Tensor, shape: tuple[int, ...] = ()) -> Tensor:
        """Draw uniform numbers in [low, high). (num_envs, *shape)"""
        if isinstance(low, Tensor):
            return torch.addcmul(low, self._uniform(0.0, 1.0, shape), high - low)
        if isinstance(high, Tensor):
            return self._uniform(0.0, 1.0, shape).mul_(high - low).add_(low)
        return self._uniform(low, high, shape)

    def uniform_of_first(self, low: float, high: float) -> Tensor:
        """Draw one uniform number for all environments: the number that environment 0 draws. (1,)"""
        return self._uniform(low, high, ())[:1]

    def normal(self, mean: float | Tensor, std: float | Tensor, shape: tuple[int, ...] = ()) -> Tensor:
        """Draw Gaussian numbers. (num_envs, *shape)"""
        return self._draw(warp_kernels.draw_normal, shape, 2).mul_(std).add_(mean)

    def choice(self, options: int, shape: tuple[int, ...] = ()) -> Tensor:
        """Draw integers in [0, options) with equal probability. (num_envs, *shape) int64"""
        return self._uniform(0.0, 1.0, shape).double().mul_(options).long()

    def read(self, field: Tensor, columns: Columns = ALL) -> Tensor:
        """Return a copy of all rows of a (num_envs, ...) tensor."""
        return field.clone() if columns is ALL else field[:, columns].clone()

    def read_view(self, field: Tensor, columns: Columns = ALL) -> Tensor:
        """Return all rows of a (num_envs, ...) tensor, if possible as a view."""
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
        """Return the mean of a (num_envs,) tensor over the masked rows; 0 for no rows. (scalar)"""
        return torch.where(self.mask, values.float(), 0.0).sum() / self.count.clamp(min=1)

    def where(self, mask: Tensor) -> MaskSelection:
        """Return a selection of the environments of this selection where `mask` (num_envs,) is true."""
        return MaskSelection(self.mask & mask, self.seed, self.counters, self.stream_key, self.shared_streams)

    def env_ids(self) -> Tensor:
        """Return the indices of the masked environments; this forces a host sync. (rows,) int64"""
        return self.mask.nonzero()[:, 0]

    def union(self, other: MaskSelection) -> MaskSelection:
        """Return a selection of the environments of this selection and of another selection."""
        return MaskSelection(self.mask | other.mask, self.seed, self.counters, shared_streams=self.shared_streams)

    def stream(self, stream: np.uint64) -> MaskSelection:
        """Return a selection of the same rows that draws from `stream`, a key of `rlcli.random.stream`."""
        return MaskSelection(self.mask, self.seed, self.counters, stream, self.shared_streams)

    def _uniform(self, low: float, high: float, shape: tuple[int, ...]) -> Tensor:
        return self._draw(warp_kernels.draw_uniform, shape, 1, low, high - low)

    def _draw(self, kernel: wp.Kernel, shape: tuple[int, ...], words: int, *parameters: float) -> Tensor:
        """Launch a kernel that computes each number from `words` random 64-bit words. (num_envs, *shape)"""
        num_envs, count, device = len(self.mask), math.prod(shape), self.mask.device
        out = torch.empty(num_envs, count, device=device)
        index, self._drawn = self._drawn, self._drawn + words * count
        if count:
            start, counters = int(random.start(self.seed)[0]), wp.from_torch(self.counters.contiguous())
            inputs = [start, counters, int(self.stream_key), index, self.shared_streams or num_envs, *parameters]
            wp.launch(kernel, (num_envs, count), inputs, [wp.from_torch(out)], device=wp.device_from_torch(device))
        return out.view(num_envs, *shape)

"""Tensors in shared memory, through which the main process and the workers exchange actions and results.

`ArraySpec` describes a tensor; each process maps the same file into its memory.
"""

from __future__ import annotations

import math
import mmap
import os
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

_ALIGNMENT = 64
"""Alignment of each tensor [bytes]: a cache line, so that two processes never write to the same line by accident."""


@dataclass(frozen=True, slots=True)
class ArraySpec:
    """Shape and type of a shared tensor."""

    shape: tuple[int, ...]
    dtype: torch.dtype

    @property
    def size(self) -> int:
        """Size of the tensor in shared memory, with the padding that aligns the next tensor [bytes]."""
        used = math.prod(self.shape) * self.dtype.itemsize
        return -(-used // _ALIGNMENT) * _ALIGNMENT


def map_tensors(descriptor: int, specs: Mapping[str, ArraySpec]) -> dict[str, Tensor]:
    """Return tensors whose memory is a shared file, by name; they follow one another in the order of `specs`.

    Processes that pass the same `specs` get tensors in the same memory.

    Args:
        descriptor: file descriptor of the shared file.
        specs: shapes and types, by name.
    """
    size = max(sum(spec.size for spec in specs.values()), _ALIGNMENT)
    if os.fstat(descriptor).st_size < size:
        os.ftruncate(descriptor, size)
    memory, offset, tensors = mmap.mmap(descriptor, size), 0, {}
    for name, spec in specs.items():
        count = math.prod(spec.shape)
        if count:
            tensors[name] = torch.frombuffer(memory, dtype=spec.dtype, count=count, offset=offset).view(spec.shape)
        else:
            tensors[name] = torch.zeros(spec.shape, dtype=spec.dtype)
        offset += spec.size
    return tensors

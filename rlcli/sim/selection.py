"""Selections of environments for resets and events: neither ids nor masks, only operations on their rows.

On the CPU a selection is a short list of ids; an engine inside a CUDA graph can only use a mask over all. Terms
written against this interface run on both.
"""

from __future__ import annotations

import math
from typing import Any, Protocol, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli import random

Columns: TypeAlias = slice | Tensor
Field: TypeAlias = Any
"""A (num_envs, ...) tensor, or what the engine's `as_field` gives for it: to make that costs as much as to read some
rows of it, so whoever reads in every step keeps it."""
ALL = slice(None)


def in_place(tensor: Tensor) -> Any:
    """The same memory as what small steps in place cost least on: on a CPU a numpy array, whose calls cost half.

    `+=`, `*=` and `[...] =` read alike on both.
    """
    return tensor.numpy() if tensor.device.type == "cpu" else tensor


def one_column(columns: Columns, count: int, parameter: str) -> int:
    """The one column that an index into `count` columns stands for.

    Raises:
        ValueError: if it stands for several.
    """
    found = torch.arange(count)[columns if isinstance(columns, slice) else columns.cpu()].tolist()
    if len(found) != 1:
        raise ValueError(f"'{parameter}' stands for {len(found)} elements, and this term needs one")
    return int(found[0])


class Selection(Protocol):
    """Rows are the selected environments, in order; `shape` is that of one row's draw."""

    @property
    def count(self) -> int | Tensor:
        """How many environments are selected."""

    def uniform(self, low: float | Tensor, high: float | Tensor, shape: tuple[int, ...] = ()) -> Tensor:
        """Uniform in [low, high). (rows, *shape)"""

    def normal(self, mean: float | Tensor, std: float | Tensor, shape: tuple[int, ...] = ()) -> Tensor:
        """Gaussian. (rows, *shape)"""

    def choice(self, options: int, shape: tuple[int, ...] = ()) -> Tensor:
        """Whole numbers in [0, options), each as likely. (rows, *shape)"""

    def read(self, field: Field, columns: Columns = ALL) -> Tensor:
        """The rows of a (num_envs, ...) tensor."""

    def read_view(self, field: Field, columns: Columns = ALL) -> Tensor:
        """Return the rows, or the tensor itself: do not write to the result, nor keep it past a write to the tensor."""

    def write(self, field: Field, values: Tensor | float, columns: Columns = ALL) -> None:
        """Set the rows of a (num_envs, ...) tensor."""

    def add(self, field: Field, values: Tensor | float, columns: Columns = ALL) -> None:
        """Add to the rows of a (num_envs, ...) tensor."""

    def mean(self, values: Tensor) -> Tensor:
        """Mean of a (num_envs,) tensor over the rows. ()"""

    def where(self, mask: Field) -> Selection | None:
        """Those of the rows where `mask` (num_envs,) holds; None if it is known that there are none."""

    def union(self, other: Any) -> Selection:
        """The rows that are in this selection or in another of the same engine."""

    def env_ids(self) -> Tensor:
        """The rows' numbers, for code that wants ids; on a GPU this waits for the device. (rows,) int64"""

    def stream(self, stream: np.uint64) -> Selection:
        """The same rows drawing from another stream."""


def write_rows(field: Field, rows: NDArray[np.int64], values: Tensor | float, columns: Columns = ALL) -> None:
    """Set some rows of a (num_envs, ...) tensor on the CPU."""
    into = field if isinstance(field, np.ndarray) else field.numpy()
    into[rows if columns is ALL else _index(rows, columns)] = values.numpy() if isinstance(values, Tensor) else values


def _index(rows: NDArray[np.int64], columns: Columns) -> Any:
    return (rows, columns) if isinstance(columns, slice) else (rows[:, None], columns.numpy())


def ids_of(selection: Selection) -> NDArray[np.int64]:
    """The rows of a selection on the CPU, sorted. (rows,)"""
    assert isinstance(selection, IdSelection)
    return selection.ids


class IdSelection:
    """A selection as a sorted list of ids, on the CPU. Its draws may be sent to a device.

    With `shared_streams`, environments i and i % shared_streams draw the same.
    """

    def __init__(
        self,
        ids: NDArray[np.int64],
        seed: int,
        counters: NDArray[np.int64],
        stream: np.uint64 | None = None,
        device: torch.device | None = None,
        shared_streams: int = 0,
    ) -> None:
        self.ids = ids
        self._shared_streams = shared_streams
        self._device = device
        self._seed = seed
        self._counters = counters
        self._keys: random.Keys | None = None
        self._stream = np.uint64(0) if stream is None else stream
        self._drawn = 0

    @property
    def count(self) -> int:
        """How many environments are selected."""
        return len(self.ids)

    def uniform(self, low: float | Tensor, high: float | Tensor, shape: tuple[int, ...] = ()) -> Tensor:
        """Uniform in [low, high). (rows, *shape)"""
        least = low.numpy(force=True) if isinstance(low, Tensor) else low
        most = high.numpy(force=True) if isinstance(high, Tensor) else high
        return self._placed(random.uniform(*self._next(math.prod(shape))), most - least, least, shape)

    def normal(self, mean: float | Tensor, std: float | Tensor, shape: tuple[int, ...] = ()) -> Tensor:
        """Gaussian. (rows, *shape)"""
        size = math.prod(shape)
        keys, stream, index, _ = self._next(2 * size)
        scale = std.numpy(force=True) if isinstance(std, Tensor) else std
        offset = mean.numpy(force=True) if isinstance(mean, Tensor) else mean
        return self._placed(random.normal(keys, stream, index, size), scale, offset, shape)

    def choice(self, options: int, shape: tuple[int, ...] = ()) -> Tensor:
        """Whole numbers in [0, options), each as likely. (rows, *shape)"""
        return self._tensor(self._shaped(random.integers(*self._next(math.prod(shape)), options), shape))

    def read(self, field: Field, columns: Columns = ALL) -> Tensor:
        """The rows of a (num_envs, ...) tensor, copied."""
        values = field if isinstance(field, np.ndarray) else field.numpy()
        return torch.from_numpy(values[self.ids if columns is ALL else _index(self.ids, columns)])

    read_view = read

    def write(self, field: Field, values: Tensor | float, columns: Columns = ALL) -> None:
        """Set the rows of a (num_envs, ...) tensor."""
        write_rows(field, self.ids, values, columns)

    def add(self, field: Field, values: Tensor | float, columns: Columns = ALL) -> None:
        """Add to the rows of a (num_envs, ...) tensor."""
        into = field if isinstance(field, np.ndarray) else field.numpy()
        into[self.ids if columns is ALL else _index(self.ids, columns)] += (
            values.numpy() if isinstance(values, Tensor) else values
        )

    def mean(self, values: Tensor) -> Tensor:
        """Mean of a (num_envs,) tensor over the rows. ()"""
        return self.read(values).float().mean()

    def where(self, mask: Field) -> IdSelection | None:
        """Those of the rows where `mask` (num_envs,) holds; None for nobody."""
        chosen = (mask if isinstance(mask, np.ndarray) else mask.numpy())[self.ids]
        if chosen.all():
            return self
        if not chosen.any():
            return None
        return IdSelection(
            self.ids[chosen], self._seed, self._counters[chosen], self._stream, self._device, self._shared_streams
        )

    def union(self, other: IdSelection) -> IdSelection:
        """The rows that are in either; one that is in both draws as it does here."""
        ids, first = np.unique(np.concatenate([self.ids, other.ids]), return_index=True)
        counters = np.concatenate([self._counters, other._counters])[first]
        return IdSelection(ids, self._seed, counters, self._stream, self._device, self._shared_streams)

    def env_ids(self) -> Tensor:
        """The rows' numbers. (rows,) int64"""
        return torch.from_numpy(self.ids)

    def stream(self, stream: np.uint64) -> IdSelection:
        """The same rows drawing from another stream."""
        other = IdSelection(self.ids, self._seed, self._counters, stream, self._device, self._shared_streams)
        other._keys = self._row_keys()
        return other

    def _placed(
        self, drawn: NDArray[Any], scale: float | NDArray[Any], offset: float | NDArray[Any], shape: tuple[int, ...]
    ) -> Tensor:
        # in numpy: the arrays are short, and its calls cost half of torch's
        values = self._shaped(drawn, shape)
        values *= scale
        values += offset
        return self._tensor(values)

    def _shaped(self, drawn: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
        return drawn if len(shape) == 1 else drawn.reshape(len(self.ids), *shape)

    def _tensor(self, drawn: NDArray[Any]) -> Tensor:
        values = torch.from_numpy(drawn)
        return values if self._device is None else values.to(self._device)

    def _row_keys(self) -> random.Keys:
        if self._keys is None:
            names = self.ids % self._shared_streams if self._shared_streams else self.ids
            self._keys = random.row_keys(self._seed, names, self._counters)
        return self._keys

    def _next(self, count: int) -> tuple[random.Keys, np.uint64, int, int]:
        index, self._drawn = self._drawn, self._drawn + count
        return self._row_keys(), self._stream, index, count

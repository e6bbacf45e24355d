"""Selections of environments, such as those to reset: read and set their rows of tensors, and draw random numbers.

On a CPU a selection is a short list of ids. On a GPU it is a mask over all environments, because a CUDA graph has fixed
sizes. A term that uses only the methods of `Selection` runs on both.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli import random

Columns: TypeAlias = slice | Tensor
"""Index of some columns of a tensor: a slice, or a tensor of positions (int64)."""
Field: TypeAlias = Any
"""A (num_envs, ...) tensor, or `Engine.as_field` of this tensor, which is faster to read and write. A term that reads
the tensor in every step calls `as_field` once, because the call takes as long as reading a few rows."""
Groups: TypeAlias = tuple[int, ...] | None
"""Geom groups; None: all."""
ALL = slice(None)
"""Index of all columns."""
DEFAULT_STREAM = np.uint64(0)
_FEW_ROWS, _AHEAD = 16, 8
"""A selection of at most `_FEW_ROWS` rows draws `_AHEAD` random numbers per row in advance, which is faster."""


def in_place(tensor: Tensor) -> Any:
    """Return a tensor's memory in the form that is fastest for small operations in place.

    On a CPU this is a numpy array, whose operations take half the time of torch's; on a GPU the tensor itself. `+=`,
    `*=` and `[...] =` work on both.
    """
    return tensor.numpy() if tensor.device.type == "cpu" else tensor


def one_column(columns: Columns, count: int, parameter: str) -> int:
    """Return the single column that an index into `count` columns selects; `parameter` is its name in the message.

    Raises:
        ValueError: if the index selects no column or several columns.
    """
    found = torch.arange(count)[columns if isinstance(columns, slice) else columns.cpu()].tolist()
    if len(found) != 1:
        raise ValueError(f"'{parameter}' selects {len(found)} elements; select exactly one")
    return int(found[0])


class Selection(Protocol):
    """Some of the environments, such as those to reset, with random numbers for them.

    Results have one row for each selected environment (on a GPU: for each environment, and only the selected rows are
    valid). `shape` is the shape of one row of random numbers.
    """

    @property
    def count(self) -> int | Tensor:
        """Number of selected environments."""

    def uniform(self, low: float | Tensor, high: float | Tensor, shape: tuple[int, ...] = ()) -> Tensor:
        """Draw uniform numbers in [low, high). (rows, *shape)"""

    def uniform_of_first(self, low: float, high: float) -> Tensor:
        """Draw one uniform number for all environments: the number that environment 0 draws. (1,)"""

    def normal(self, mean: float | Tensor, std: float | Tensor, shape: tuple[int, ...] = ()) -> Tensor:
        """Draw Gaussian numbers. (rows, *shape)"""

    def choice(self, options: int, shape: tuple[int, ...] = ()) -> Tensor:
        """Draw integers in [0, options) with equal probability. (rows, *shape) int64"""

    def read(self, field: Field, columns: Columns = ALL) -> Tensor:
        """Return a copy of the selected environments' rows of a (num_envs, ...) tensor."""

    def read_view(self, field: Field, columns: Columns = ALL) -> Tensor:
        """Return the selected rows of a (num_envs, ...) tensor, if possible as a view.

        Do not write to the result, and do not use it after a write to the tensor.
        """

    def write(self, field: Field, values: Tensor | float, columns: Columns = ALL) -> None:
        """Set the selected environments' rows of a (num_envs, ...) tensor; `values` has one row for each of them."""

    def add(self, field: Field, values: Tensor | float, columns: Columns = ALL) -> None:
        """Add to the selected environments' rows of a (num_envs, ...) tensor; `values` has one row for each of them."""

    def mean(self, values: Tensor) -> Tensor:
        """Return the mean of a (num_envs,) tensor over the selected environments. (scalar)"""

    def where(self, mask: Field) -> Selection | None:
        """Return a selection of the selected environments where `mask` (num_envs,) is true.

        Return None if the result is known to be empty; on a GPU this is not known, and None is never returned.
        """

    def union(self, other: Any) -> Selection:
        """Return a selection of the environments of this selection and of another selection of the same engine."""

    def env_ids(self) -> Tensor:
        """Return the indices of the environments; on a GPU this forces a host sync. (rows,) int64"""

    def stream(self, stream: np.uint64) -> Selection:
        """Return a selection of the same environments with another random stream, a result of `rlcli.random.stream`."""


def _as_array(values: Any) -> Any:
    """Return a CPU tensor as a numpy array of the same memory; return any other value unchanged."""
    return values.numpy() if isinstance(values, Tensor) else values


def _on_host(value: Tensor | float) -> Any:
    """Return a tensor on any device as a numpy array; return a number unchanged."""
    return value.numpy(force=True) if isinstance(value, Tensor) else value


def write_rows(field: Field, rows: NDArray[np.int64], values: Tensor | float, columns: Columns = ALL) -> None:
    """Set some rows of a (num_envs, ...) tensor on the CPU."""
    _as_array(field)[_index(rows, columns)] = _as_array(values)


def _index(rows: NDArray[np.int64], columns: Columns) -> Any:
    """Return an index of some columns in some rows."""
    if columns is ALL:
        return rows
    return (rows, columns) if isinstance(columns, slice) else (rows[:, None], columns.numpy())


def ids_of(selection: Selection) -> NDArray[np.int64]:
    """Return the sorted ids of a selection on the CPU. (rows,)"""
    assert isinstance(selection, IdSelection)
    return selection.ids


@dataclass(eq=False)
class IdSelection:
    """Selection as a sorted list of ids, on the CPU.

    Args:
        ids: the selected environments, sorted. (rows,)
        seed: seed of the random numbers.
        counters: index of each row's random sequence, usually its episode. (rows,)
        stream_key: key of the purpose of the random numbers (for example a term), a result of `rlcli.random.stream`.
        device: device of the random numbers; None: the CPU.
        stream_ids: index of each environment's random stream: environments with the same index draw the same random
            numbers; None: the id of the environment. (num_envs,)
    """

    ids: NDArray[np.int64]
    seed: int
    counters: NDArray[np.int64]
    stream_key: np.uint64 = DEFAULT_STREAM
    device: torch.device | None = None
    stream_ids: NDArray[np.int64] | None = None
    _keys: random.Keys | None = field(default=None, init=False)
    _drawn: int = field(default=0, init=False)
    _ready: tuple[int, NDArray[np.float32] | None] = field(default=(0, None), init=False)
    """Uniform numbers drawn in advance: (index of the first number in the random stream, numbers (rows, n))."""

    @property
    def count(self) -> int:
        """Number of selected environments."""
        return len(self.ids)

    def uniform(self, low: float | Tensor, high: float | Tensor, shape: tuple[int, ...] = ()) -> Tensor:
        """Draw uniform numbers in [low, high). (rows, *shape)"""
        lowest, highest = _on_host(low), _on_host(high)
        return self._scaled(self._units(math.prod(shape)), highest - lowest, lowest, shape)

    def uniform_of_first(self, low: float, high: float) -> Tensor:
        """Draw one uniform number for all environments: the number that environment 0 draws. (1,)"""
        first = np.zeros(1, np.int64)
        return IdSelection(first, self.seed, self.counters[:1], self.stream_key, self.device).uniform(low, high)

    def normal(self, mean: float | Tensor, std: float | Tensor, shape: tuple[int, ...] = ()) -> Tensor:
        """Draw Gaussian numbers. (rows, *shape)"""
        size = math.prod(shape)
        keys, stream, index, _ = self._next(2 * size)  # two uniform numbers make a Gaussian one
        return self._scaled(random.normal(keys, stream, index, size), _on_host(std), _on_host(mean), shape)

    def choice(self, options: int, shape: tuple[int, ...] = ()) -> Tensor:
        """Draw integers in [0, options) with equal probability. (rows, *shape) int64"""
        return self._tensor(self._shaped(random.integers(*self._next(math.prod(shape)), options), shape))

    def read(self, field: Field, columns: Columns = ALL) -> Tensor:
        """Return a copy of the selected environments' rows of a (num_envs, ...) tensor."""
        return torch.from_numpy(_as_array(field)[_index(self.ids, columns)])

    read_view = read

    def write(self, field: Field, values: Tensor | float, columns: Columns = ALL) -> None:
        """Set the selected environments' rows of a (num_envs, ...) tensor."""
        write_rows(field, self.ids, values, columns)

    def add(self, field: Field, values: Tensor | float, columns: Columns = ALL) -> None:
        """Add to the selected environments' rows of a (num_envs, ...) tensor."""
        _as_array(field)[_index(self.ids, columns)] += _as_array(values)

    def mean(self, values: Tensor) -> Tensor:
        """Return the mean of a (num_envs,) tensor over the selected environments. (scalar)"""
        return self.read(values).float().mean()

    def where(self, mask: Field) -> IdSelection | None:
        """Return a selection of the rows where `mask` (num_envs,) is true; None if there are none."""
        chosen = _as_array(mask)[self.ids]
        if chosen.all():
            return self
        if not chosen.any():
            return None
        return self._with(self.ids[chosen], self.counters[chosen], self.stream_key)

    def union(self, other: IdSelection) -> IdSelection:
        """Return a selection of the environments of this selection and of `other`.

        Environments of both keep the counters of this selection.
        """
        ids, first = np.unique(np.concatenate([self.ids, other.ids]), return_index=True)
        counters = np.concatenate([self.counters, other.counters])[first]
        return self._with(ids, counters, self.stream_key)

    def env_ids(self) -> Tensor:
        """Return the indices of the environments. (rows,) int64"""
        return torch.from_numpy(self.ids)

    def stream(self, stream: np.uint64) -> IdSelection:
        """Return a selection of the same rows with another random stream, a result of `rlcli.random.stream`."""
        other = self._with(self.ids, self.counters, stream)
        other._keys = self._row_keys()
        return other

    def _with(self, ids: NDArray[np.int64], counters: NDArray[np.int64], stream_key: np.uint64) -> IdSelection:
        return IdSelection(ids, self.seed, counters, stream_key, self.device, self.stream_ids)

    def _scaled(
        self, drawn: NDArray[Any], scale: float | NDArray[Any], offset: float | NDArray[Any], shape: tuple[int, ...]
    ) -> Tensor:
        # in numpy: the arrays are short, and numpy's calls take half the time of torch's
        values = self._shaped(drawn, shape)
        values *= scale
        values += offset
        return self._tensor(values)

    def _shaped(self, drawn: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
        return drawn if len(shape) == 1 else drawn.reshape(len(self.ids), *shape)

    def _tensor(self, drawn: NDArray[Any]) -> Tensor:
        values = torch.from_numpy(drawn)
        return values if self.device is None else values.to(self.device)

    def _row_keys(self) -> random.Keys:
        if self._keys is None:
            streams = self.ids if self.stream_ids is None else self.stream_ids[self.ids]
            self._keys = random.row_keys(self.seed, streams, self.counters)
        return self._keys

    def _units(self, count: int) -> NDArray[np.float32]:
        """Return the next `count` uniform numbers in [0, 1) of each row. (rows, count)

        For few rows, several numbers take as long as one, so further numbers are computed in advance.
        """
        if len(self.ids) > _FEW_ROWS or count >= _AHEAD:
            return random.uniform(*self._next(count))
        first, ready = self._ready
        begin = self._drawn - first
        if ready is None or begin + count > ready.shape[1]:
            ready, begin = random.uniform(self._row_keys(), self.stream_key, self._drawn, _AHEAD), 0
            self._ready = self._drawn, ready
        self._drawn += count
        return ready[:, begin : begin + count].copy()

    def _next(self, count: int) -> tuple[random.Keys, np.uint64, int, int]:
        """Return the arguments of `random.uniform` for the next `count` numbers of each row."""
        index, self._drawn = self._drawn, self._drawn + count
        return self._row_keys(), self.stream_key, index, count

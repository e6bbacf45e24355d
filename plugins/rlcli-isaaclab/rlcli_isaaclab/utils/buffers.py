"""Buffers that store tensors of past steps: a history, and a delay.

A task of Isaac Lab that imports a name from `isaaclab.utils.buffers` gets the object of this name from here.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


class CircularBuffer:
    """Buffer of the last `max_len` values of every environment. After a reset the first value fills it."""

    def __init__(self, max_len: int, batch_size: int, device: Any) -> None:
        if max_len < 1:
            raise ValueError(f"the length of a buffer must be at least 1, found {max_len}")
        self.max_length, self.batch_size, self.device = max_len, batch_size, device
        self.current_length = torch.zeros(batch_size, dtype=torch.int64, device=device)
        """Number of values since the last reset, at most `max_length`. (batch,)"""
        self._values: Tensor | None = None

    @property
    def buffer(self) -> Tensor:
        """Stored values, the oldest first. (batch, max_length, ...)"""
        return self._stored().clone()

    def reset(self, batch_ids: Any = None) -> None:
        """Remove the values of the environments `batch_ids`; None: of all."""
        rows = slice(None) if batch_ids is None else batch_ids
        self.current_length[rows] = 0
        if self._values is not None:
            self._values[rows] = 0

    def append(self, data: Tensor) -> None:
        """Add a value for every environment. (batch, ...)"""
        if len(data) != self.batch_size:
            raise ValueError(
                f"the buffer has {self.batch_size} environments, found {len(data)} rows; pass one row for each"
            )
        data = data.to(self.device)
        if self._values is None:
            self._values = data.unsqueeze(1).repeat_interleave(self.max_length, dim=1)
        else:
            moved = torch.cat([self._values[:, 1:], data.unsqueeze(1)], dim=1)
            is_first = (self.current_length == 0).view(-1, *[1] * (moved.dim() - 1))
            self._values = torch.where(is_first, data.unsqueeze(1), moved)
        self.current_length = (self.current_length + 1).clamp(max=self.max_length)

    def __getitem__(self, key: Tensor) -> Tensor:
        """Return the value of `key` steps ago in each environment, at most the oldest one. (batch,) -> (batch, ...)"""
        values = self._stored()
        if bool((self.current_length == 0).any()):
            raise RuntimeError("the buffer is empty: append a value first")
        lag = torch.minimum(torch.as_tensor(key, device=self.device).long(), self.current_length - 1)
        return values[torch.arange(self.batch_size, device=self.device), self.max_length - 1 - lag]

    def _stored(self) -> Tensor:
        if self._values is None:
            raise RuntimeError("the buffer is empty: append a value first")
        return self._values


class DelayBuffer:
    """Buffer that returns each value some steps later; every environment has its own delay, called lag."""

    def __init__(self, history_length: int, batch_size: int, device: Any) -> None:
        self.history_length, self.batch_size, self.device = max(0, history_length), batch_size, device
        self.time_lags = torch.zeros(batch_size, dtype=torch.int64, device=device)
        self._history = CircularBuffer(self.history_length + 1, batch_size, device)

    @property
    def min_time_lag(self) -> int:
        """The shortest lag [steps]."""
        return int(self.time_lags.min())

    @property
    def max_time_lag(self) -> int:
        """The longest lag [steps]."""
        return int(self.time_lags.max())

    def set_time_lag(self, time_lag: Any, batch_ids: Any = None) -> None:
        """Set the delays of the environments `batch_ids` [steps]; None: of all."""
        lags = torch.as_tensor(time_lag, device=self.device).long()
        if int(lags.min()) < 0 or int(lags.max()) > self.history_length:
            raise ValueError(f"a lag must be between 0 and {self.history_length}, found {time_lag}")
        self.time_lags[slice(None) if batch_ids is None else batch_ids] = lags

    def reset(self, batch_ids: Any = None) -> None:
        """Remove the values of the environments `batch_ids`; None: of all."""
        self._history.reset(batch_ids)

    def compute(self, data: Tensor) -> Tensor:
        """Add a value for every environment, and return the values of `time_lags` steps ago. (batch, ...) each"""
        self._history.append(data)
        return self._history[self.time_lags].clone()


@dataclass
class TimestampedBuffer:
    """A value and the time of its last update [s]."""

    data: Any = None
    timestamp: float = -1.0


def tensors_of(holder: object) -> dict[str, Tensor]:
    """Return the tensors in the attributes of an object, and of buffers in its attributes, by name.

    The names are paths of attributes, such as `history._values`.
    """
    found: dict[str, Tensor] = {}
    for name, value in vars(holder).items():
        if isinstance(value, Tensor):
            found[name] = value
        elif isinstance(value, CircularBuffer | DelayBuffer):
            found |= {f"{name}.{inner}": tensor for inner, tensor in tensors_of(value).items()}
    return found


def set_tensors(holder: object, tensors: Mapping[str, Tensor]) -> None:
    """Restore tensors returned by `tensors_of`."""
    for path, value in tensors.items():
        name, _, inner = path.partition(".")
        if inner:
            set_tensors(getattr(holder, name), {inner: value})
        else:
            setattr(holder, name, value.clone())


def call_without_effects(holders: Sequence[object], function: Callable[[], T]) -> T:
    """Call a function, and then restore the attributes of objects, and torch's random generator.

    Buffers, and tensors in lists, dicts and other containers of the objects, get their values back, too.
    """
    saved = [(vars(holder), dict(vars(holder))) for holder in holders]
    for _, attributes in saved:
        saved += [(vars(v), dict(vars(v))) for v in attributes.values() if isinstance(v, CircularBuffer | DelayBuffer)]
    values = [value for _, attributes in saved for value in attributes.values()]
    containers = [(value, copy.copy(value)) for value in values if isinstance(value, list | dict | set | deque)]
    values += [item for _, items in containers for item in (items.values() if isinstance(items, dict) else items)]
    tensors = [(value, value.clone()) for value in values if isinstance(value, Tensor)]
    generator = torch.get_rng_state()
    found = function()
    for attributes, before in saved:
        attributes.clear()
        attributes.update(before)
    for container, items in containers:
        container.clear()
        container.update(items) if isinstance(container, dict | set) else container.extend(items)
    for tensor, value in tensors:
        if not torch.equal(tensor, value):
            tensor.copy_(value)
    torch.set_rng_state(generator)
    return found

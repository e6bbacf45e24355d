"""What an object of a task's author remembers from step to step: found in its attributes, saved and put back.

Tensors and arrays are saved as they are, in dicts, lists and tuples too. Plain values, containers of them
and random generators are saved once they have changed since the object was built. What else may change cannot be
saved, and is named.
"""

from __future__ import annotations

import collections
import contextlib
import json
import random
import threading
import types
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

_PLAIN = "plain"
"""Key of everything that is not a tensor, as JSON in bytes."""
_OURS = ("rlcli.", "torch.", "numpy.", "mujoco.")


class Unsaved(TypeError):
    """A value that cannot be written down."""


class TermState:
    """The attributes of an object, and of helper objects of its author's that they hold, which outlast a step.

    Args:
        owner: the object, as it is before the first step.
        other: names of attributes that are somebody else's to save.
    """

    def __init__(self, owner: object, other: tuple[str, ...] = ()) -> None:
        self._owner, self._other = owner, other
        self._first = dict(self._plain())
        self._changed: set[str] = set()

    def state_dict(self) -> dict[str, Tensor]:
        """Copies of what is remembered now."""
        state = {path: value.clone() for slot, value in self._slots() for path, value in _tensors(slot, value)}
        values = dict(self._plain())
        self._changed |= {slot for slot, value in values.items() if value != self._first.get(slot)}
        kept = {slot: values[slot] for slot in sorted(self._changed & set(values))}
        if kept:
            state[_PLAIN] = torch.frombuffer(bytearray(json.dumps(kept).encode()), dtype=torch.uint8)
        return state

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the state returned by `state_dict()`.

        Existing tensors keep their place, so that views of them stay valid.

        Raises:
            ValueError: if it does not belong to this object.
        """
        kept = json.loads(bytes(state[_PLAIN].tolist())) if _PLAIN in state else {}
        for slot in self._changed | set(kept):
            written = kept.get(slot, self._first.get(slot))
            if written is not None:
                self._put(slot, _read(json.loads(written)))
        self._changed |= set(kept)
        for path, value in state.items():
            if path != _PLAIN:
                self._put_tensor(path, value)

    def unsaved(self) -> list[str]:
        """What may change and cannot be saved, with its type."""
        owner = type(self._owner).__name__
        return [f"{owner}.{slot} ({type(value).__name__})" for slot, value in self._slots() if _is_stateful(value)]

    def _slots(self) -> Iterator[tuple[str, Any]]:
        """Attributes by their path: of the object, and of what is made of its author's classes."""
        seen: set[int] = set()

        def visit(holder: object, path: str) -> Iterator[tuple[str, Any]]:
            seen.add(id(holder))
            for name, value in list(vars(holder).items()):
                if path or name not in self._other:
                    yield f"{path}{name}", value
                    if _is_helper(value) and id(value) not in seen:
                        yield from visit(value, f"{path}{name}.")

        yield from visit(self._owner, "")

    def _plain(self) -> Iterator[tuple[str, str]]:
        """What can be written down, as JSON."""
        for slot, value in self._slots():
            with contextlib.suppress(Unsaved, RecursionError):
                yield slot, json.dumps(_written(value))

    def _holder(self, slot: str) -> tuple[Any, str]:
        """What a slot is an attribute of: only what is found there may be written to, whoever wrote the file."""
        *path, name = slot.split(".")
        holder = self._owner
        for step in path:
            holder = vars(holder).get(step)
            if not _is_helper(holder):
                raise ValueError(f"'{slot}' has no place in {type(self._owner).__name__}")
        usual = getattr(type(holder), name, None)  # a method or a property is no memory
        allowed = name.isidentifier() and not name.startswith("__") and (bool(path) or name not in self._other)
        if not allowed or not _may_be_memory(usual) or not _may_be_memory(vars(holder).get(name)):
            raise ValueError(f"'{slot}' is nothing that {type(self._owner).__name__} remembers")
        return holder, name

    def _put(self, slot: str, value: Any) -> None:
        holder, name = self._holder(slot)
        there = getattr(holder, name, None)
        if isinstance(there, random.Random):
            there.setstate(value)
        elif isinstance(there, np.random.Generator):
            _require_positions(value)
            there.bit_generator.state = value
        elif isinstance(there, list | dict | set | collections.deque) and type(there) is type(value):
            there.clear()  # whoever else holds it sees the same
            there.update(value) if isinstance(there, dict | set) else there.extend(value)
        else:
            setattr(holder, name, value)

    def _put_tensor(self, path: str, value: Tensor) -> None:
        slot, *keys = path.split("/")
        holder, name = self._holder(slot)
        if not keys:
            if not _write_into(getattr(holder, name, None), value):
                setattr(holder, name, value.clone())  # made, or made anew, in a step
            return
        container = getattr(holder, name, None)
        for key in keys[:-1]:
            container = _item(container, key)
        key = keys[-1]
        there = _item(container, key)
        if _write_into(there, value):
            return
        if not (there is None or isinstance(there, Tensor | np.ndarray)):
            raise ValueError(f"'{path}' is no tensor in {type(self._owner).__name__}")
        if isinstance(container, dict):
            container[key] = value.clone()
        elif isinstance(container, list):
            container[int(key) : int(key) + 1] = [value.clone()]
        else:
            raise ValueError(f"'{path}' has no place in {type(self._owner).__name__}")


def _item(container: object, key: str) -> Any:
    if isinstance(container, dict):
        return container.get(key)
    if isinstance(container, list | tuple):
        return container[int(key)] if int(key) < len(container) else None
    return None


def _write_into(there: object, value: Tensor) -> bool:
    """Write a value where it was, if that is the place for it."""
    if isinstance(there, torch.Generator):
        there.set_state(value)
    elif isinstance(there, np.ndarray) and there.shape == tuple(value.shape):
        there[...] = value.numpy()
    elif isinstance(there, Tensor) and there.shape == value.shape and there.dtype == value.dtype:
        there.copy_(value)
    else:
        return False
    return True


def _tensors(path: str, value: object) -> Iterator[tuple[str, Tensor]]:
    """Every tensor, array and torch generator in a value, by its path."""
    if isinstance(value, Tensor):
        yield path, value.detach()
    elif isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        yield path, torch.from_numpy(np.ascontiguousarray(value))
    elif isinstance(value, torch.Generator):
        yield path, value.get_state()
    elif isinstance(value, dict):
        for key, item in value.items():
            if isinstance(key, str) and "/" not in key:
                yield from _tensors(f"{path}/{key}", item)
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _tensors(f"{path}/{index}", item)


def _written(value: Any) -> Any:
    """A value as JSON that `_read` understands."""
    if value is None or isinstance(value, bool | int | float | str):
        if type(value) in (bool, int, float, str, type(None)):
            return value
        raise Unsaved
    if isinstance(value, np.bool_ | np.integer | np.floating):
        return ["scalar", value.dtype.name, value.item()]
    if isinstance(value, random.Random):
        return _written(value.getstate())
    if isinstance(value, np.random.Generator):
        return _written(value.bit_generator.state)
    kinds: dict[type, str] = {list: "list", tuple: "tuple", set: "set", collections.deque: "deque"}
    if type(value) in kinds:
        items = sorted(value, key=repr) if isinstance(value, set) else value
        return [kinds[type(value)], [_written(item) for item in items]]
    if type(value) is dict:
        return ["dict", [[_written(key), _written(item)] for key, item in value.items()]]
    raise Unsaved


def _read(written: object) -> Any:
    if not isinstance(written, list):
        return written
    kind, *content = written
    if kind == "scalar":
        dtype = np.dtype(content[0])
        if dtype.kind not in "biuf":
            raise ValueError(f"'{content[0]}' is no kind of number")
        return dtype.type(content[1])
    if kind == "dict":
        return {_read(key): _read(item) for key, item in content[0]}
    make = {"list": list, "tuple": tuple, "set": set, "deque": collections.deque}[kind]
    return make(_read(item) for item in content[0])


def _may_be_memory(value: object) -> bool:
    """Whether something is of a kind that is saved."""
    generators = torch.Generator | np.random.Generator | random.Random
    plain = type(value) in (bool, int, float, str, type(None), list, tuple, dict, set, collections.deque)
    return plain or isinstance(value, Tensor | np.ndarray | np.generic | generators)


def _require_positions(state: Mapping[str, Any]) -> None:
    """Where a generator goes on in its table: numpy does not look whether that is inside."""
    inner = state.get("state")
    pos = inner.get("pos", 0) if isinstance(inner, dict) else 0
    if not 0 <= int(pos) <= 624 or not 0 <= int(state.get("buffer_pos", 0)) <= 4:
        raise ValueError("a generator of numpy would go on outside of its table")


def _is_helper(value: object) -> bool:
    """Whether a value is made of a class of the author's, whose attributes are looked through as well."""
    bases = [kind.__module__ for kind in type(value).__mro__[:-1]]
    if (
        not bases
        or isinstance(value, type)
        or any(f"{base}.".startswith(_OURS) or base == "builtins" for base in bases)
    ):
        return False
    return hasattr(value, "__dict__") and not isinstance(value, types.ModuleType) and not callable(value)


def _is_stateful(value: object) -> bool:
    """Whether a value has a state of its own that cannot be written down: a generator, a stream, a file."""
    if isinstance(value, Iterator | np.random.RandomState | threading.Thread):
        return True
    odd = isinstance(value, dict) and any(isinstance(v, Tensor) and not isinstance(k, str) for k, v in value.items())
    return odd or hasattr(value, "readline")

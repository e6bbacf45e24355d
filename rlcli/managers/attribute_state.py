"""State of a task's own objects: attributes that change from step to step, saved in checkpoints and restored.

Tensors, arrays and torch generators are always saved, also in dicts, lists and tuples. Plain values, containers of
plain values and other random generators are saved only after they have changed. Other attributes that may change cannot
be saved; `AttributeState.unsaved` lists these attributes.
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
"""Key of a saved state under which all values that are not tensors are stored, as JSON text in a uint8 tensor."""
_SCALARS = (bool, int, float, str, type(None))
_SEQUENCES = (list, tuple, set, collections.deque)
_LIBRARIES = ("builtins.", "rlcli.", "torch.", "numpy.", "mujoco.")


class NotSerializableError(TypeError):
    """Error for a value that JSON cannot contain."""


class AttributeState:
    """Saver of the attributes of an object of a task, and of the objects of the task's classes among these attributes.

    Args:
        owner: the object. Create the saver before the first step: a value counts as changed if it differs from the
            value at that time.
        excluded: names of attributes that are not saved.
    """

    def __init__(self, owner: object, excluded: tuple[str, ...] = ()) -> None:
        self._owner, self._excluded = owner, excluded
        self._first = dict(self._plain())
        self._changed: set[str] = set()

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the attributes' values as tensors, by their path (`name`, or `helper.name`)."""
        tensors = (found for attribute, value in self._attributes() for found in _tensors(attribute, value))
        state = {path: tensor.clone() for path, tensor in tensors}
        values = dict(self._plain())
        self._changed |= {attribute for attribute, value in values.items() if value != self._first.get(attribute)}
        kept = {attribute: values[attribute] for attribute in sorted(self._changed & set(values))}
        if kept:
            state[_PLAIN] = torch.frombuffer(bytearray(json.dumps(kept).encode()), dtype=torch.uint8)
        return state

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the state returned by `state_dict()`.

        Tensors are written in place, so that views of them stay valid.

        Raises:
            ValueError: if the state does not belong to this object.
        """
        kept = json.loads(bytes(state[_PLAIN].tolist())) if _PLAIN in state else {}
        for attribute in self._changed | set(kept):
            written = kept.get(attribute, self._first.get(attribute))
            if written is not None:
                self._put(attribute, _from_json(json.loads(written)))
        self._changed |= set(kept)
        for path, value in state.items():
            if path != _PLAIN:
                self._put_tensor(path, value)

    def unsaved(self) -> list[str]:
        """Return the attributes that may change and cannot be saved, with their types."""
        owner = type(self._owner).__name__
        unsaved = [(attribute, value) for attribute, value in self._attributes() if _cannot_be_saved(value)]
        return [f"{owner}.{attribute} ({type(value).__name__})" for attribute, value in unsaved]

    def _attributes(self) -> Iterator[tuple[str, Any]]:
        """Yield path and value of each attribute of the object and of its helper objects."""
        seen: set[int] = set()

        def visit(holder: object, path: str) -> Iterator[tuple[str, Any]]:
            seen.add(id(holder))
            for name, value in list(vars(holder).items()):
                if path or name not in self._excluded:
                    yield f"{path}{name}", value
                    if _is_helper(value) and id(value) not in seen:
                        yield from visit(value, f"{path}{name}.")

        yield from visit(self._owner, "")

    def _plain(self) -> Iterator[tuple[str, str]]:
        """Yield the path and the JSON text of each attribute that can be written as JSON."""
        for attribute, value in self._attributes():
            with contextlib.suppress(NotSerializableError, RecursionError):
                yield attribute, json.dumps(_to_json(value))

    def _holder(self, attribute: str) -> tuple[Any, str]:
        """Return the object and the name of the attribute at a path.

        Raises:
            ValueError: for a path that is not saved: the file is not trusted, and could name any attribute.
        """
        *path, name = attribute.split(".")
        holder = self._owner
        for step in path:
            holder = vars(holder).get(step)
            if not _is_helper(holder):
                raise ValueError(
                    f"the checkpoint has a value for '{attribute}', but class {type(self._owner).__name__} has no such"
                    " attribute any more: restore the old code of the class"
                )
        on_class = getattr(type(holder), name, None)  # a method or a property is not state
        allowed = name.isidentifier() and not name.startswith("__") and (bool(path) or name not in self._excluded)
        if not allowed or not _is_saved_kind(on_class) or not _is_saved_kind(vars(holder).get(name)):
            raise ValueError(
                f"the checkpoint has a value for '{attribute}', which class {type(self._owner).__name__} does not save:"
                " the file is damaged, or the code has changed; use another checkpoint, or restore the old code"
            )
        return holder, name

    def _put(self, attribute: str, value: Any) -> None:
        holder, name = self._holder(attribute)
        current = getattr(holder, name, None)
        if isinstance(current, random.Random):
            current.setstate(value)
        elif isinstance(current, np.random.Generator):
            _require_valid_position(attribute, value)
            current.bit_generator.state = value
        elif isinstance(current, list | dict | set | collections.deque) and type(current) is type(value):
            current.clear()  # in place: other references to the container stay valid
            current.update(value) if isinstance(current, dict | set) else current.extend(value)
        else:
            setattr(holder, name, value)

    def _put_tensor(self, path: str, value: Tensor) -> None:
        attribute, *keys = path.split("/")
        holder, name = self._holder(attribute)
        if not keys:
            if not _write_into(getattr(holder, name, None), value):
                setattr(holder, name, value.clone())  # a step creates or replaces this tensor
            return
        container = getattr(holder, name, None)
        for key in keys[:-1]:
            container = _item(container, key)
        key = keys[-1]
        current = _item(container, key)
        if _write_into(current, value):
            return
        if not (current is None or isinstance(current, Tensor | np.ndarray)):
            raise ValueError(
                f"the saved value '{path}' is a tensor, but class {type(self._owner).__name__} has no tensor there;"
                " restore the old code of the class"
            )
        if isinstance(container, dict):
            container[key] = value.clone()
        elif isinstance(container, list):
            container[int(key) : int(key) + 1] = [value.clone()]
        else:
            raise ValueError(
                f"class {type(self._owner).__name__} has no attribute for the saved value '{path}';"
                " restore the old code of the class"
            )


def _item(container: object, key: str) -> Any:
    if isinstance(container, dict):
        return container.get(key)
    if isinstance(container, list | tuple):
        return container[int(key)] if int(key) < len(container) else None
    return None


def _write_into(target: object, value: Tensor) -> bool:
    """Copy a value into a tensor, array or random generator in place; return False if type or shape do not fit."""
    if isinstance(target, torch.Generator):
        target.set_state(value)
    elif isinstance(target, np.ndarray) and target.shape == tuple(value.shape):
        target[...] = value.numpy()
    elif isinstance(target, Tensor) and target.shape == value.shape and target.dtype == value.dtype:
        target.copy_(value)
    else:
        return False
    return True


def _tensors(path: str, value: object) -> Iterator[tuple[str, Tensor]]:
    """Yield the tensors, arrays and torch generators in a value, by their path."""
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


def _to_json(value: Any) -> Any:
    """Return a value as data for JSON, from which `_from_json` restores the value.

    Raises:
        NotSerializableError: for a value that JSON cannot contain.
    """
    if type(value) in _SCALARS:
        return value
    if isinstance(value, np.bool_ | np.integer | np.floating):
        return ["scalar", value.dtype.name, value.item()]
    if isinstance(value, random.Random):
        return _to_json(value.getstate())
    if isinstance(value, np.random.Generator):
        return _to_json(value.bit_generator.state)
    if type(value) in _SEQUENCES:
        items = sorted(value, key=repr) if isinstance(value, set) else value
        return [type(value).__name__, [_to_json(item) for item in items]]
    if type(value) is dict:
        return ["dict", [[_to_json(key), _to_json(item)] for key, item in value.items()]]
    raise NotSerializableError


def _from_json(written: object) -> Any:
    if not isinstance(written, list):
        return written
    kind, *content = written
    if kind == "scalar":
        dtype = np.dtype(content[0])
        if dtype.kind not in "biuf":
            raise ValueError(f"a saved value has the type '{content[0]}', which is not a number: the file is damaged")
        return dtype.type(content[1])
    if kind == "dict":
        return {_from_json(key): _from_json(item) for key, item in content[0]}
    make = {sequence.__name__: sequence for sequence in _SEQUENCES}[kind]
    return make(_from_json(item) for item in content[0])


def _is_saved_kind(value: object) -> bool:
    """Return whether a value is of a type that is saved (numbers, texts, containers, tensors, random generators)."""
    generators = torch.Generator | np.random.Generator | random.Random
    plain = (*_SCALARS, *_SEQUENCES, dict)
    return type(value) in plain or isinstance(value, Tensor | np.ndarray | np.generic | generators)


def _require_valid_position(attribute: str, state: Mapping[str, Any]) -> None:
    """Check the saved position of a numpy generator in its buffer: numpy would read outside of the buffer.

    The buffer of MT19937 has 624 numbers, that of Philox has 4.
    """
    inner = state.get("state")
    pos = inner.get("pos", 0) if isinstance(inner, dict) else 0
    if not 0 <= int(pos) <= 624 or not 0 <= int(state.get("buffer_pos", 0)) <= 4:
        raise ValueError(
            f"'{attribute}': the saved position of the numpy generator is outside of its buffer: the file is damaged"
        )


def _is_helper(value: object) -> bool:
    """Return whether a value is an object of the task's own class, whose attributes are saved as well."""
    bases = [kind.__module__ for kind in type(value).__mro__[:-1]]
    if not bases or isinstance(value, type) or any(f"{base}.".startswith(_LIBRARIES) for base in bases):
        return False
    return hasattr(value, "__dict__") and not isinstance(value, types.ModuleType) and not callable(value)


def _cannot_be_saved(value: object) -> bool:
    """Return whether a value may change but cannot be saved.

    Such values are iterators, RandomStates, threads, open files, and dicts of tensors whose keys are not strings.
    """
    if isinstance(value, Iterator | np.random.RandomState | threading.Thread):
        return True
    entries = value.items() if isinstance(value, dict) else ()
    return hasattr(value, "readline") or any(isinstance(v, Tensor) and not isinstance(k, str) for k, v in entries)

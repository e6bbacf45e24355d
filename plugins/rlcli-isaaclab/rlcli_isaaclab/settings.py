"""Reading of Isaac Lab's settings, which are nested dicts, with a report of how each key was translated.

A key that no reader has read is reported as ignored.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from rlcli.errors import ConfigError, Problem
from rlcli.formats import Note, Status
from rlcli_isaaclab.config_class import is_missing

Key = tuple[str, ...]


@dataclass(slots=True)
class Report:
    """Record of how each key of a configuration was translated, and of the mistakes in the configuration."""

    entries: dict[Key, tuple[Status, str]] = field(default_factory=dict)
    """Key -> (status, reason). The status is `mapped`, `approximated`, `ignored`, `default` or `to do`."""
    problems: list[Problem] = field(default_factory=list)
    stubs: dict[str, tuple[str, dict[str, Any]]] = field(default_factory=dict)
    """Functions of which the imported YAML only has the name: name -> (section of the term, its parameters).

    The user must write their code; `rlcli import` writes an empty function for each.
    """

    def notes(self, prefix: str = "", where: str = "") -> list[Note]:
        """Return one note for each key: `prefix` and its path, its status and the reason. `where` names the file."""
        start = f"{prefix}." if prefix else ""
        return [Note(where, start + ".".join(key), *entry) for key, entry in self.entries.items()]

    def user_notes(self, prefix: str = "") -> list[Note]:
        """Return the notes of keys that were approximated or ignored, or that the user must translate."""
        return [note for note in self.notes(prefix) if note.status not in ("mapped", "default")]

    def problem(self, key: Key, message: str, hint: str | None = None) -> None:
        """Record a mistake at a key; `finish` raises an error with all of them."""
        self.problems.append(Problem("configuration", ".".join(map(str, key)), message, hint))

    def matching(self, patterns: Any, names: Sequence[str], key: Key) -> list[str]:
        """Return the joints in `names` that match one of `patterns`: names or regular expressions from a file.

        A pattern that is not a text, not a regular expression, or takes long to compare, is recorded as a mistake.
        """
        from rlcli.scene.names import NameProblem, search

        found: set[int] = set()
        for pattern in [patterns] if isinstance(patterns, str) else patterns:
            try:
                if not isinstance(pattern, str):
                    raise NameProblem(f"expected the name of a joint or a regular expression, found {pattern!r}")
                found.update(search(pattern, names, "joint"))
            except NameProblem as problem:
                if str(problem) not in [known.message for known in self.problems]:
                    self.problem(key, str(problem), problem.hint)
        return [name for index, name in enumerate(names) if index in found]

    def finish(self, data: Any, defaults: Any = None) -> None:
        """Mark the keys that were never read as ignored, or as default if they have their default value.

        Raises:
            ConfigError: with all mistakes that were recorded.
        """
        self._mark_unread(data, (), defaults)
        if self.problems:
            raise ConfigError(self.problems)

    def _mark_unread(self, value: Any, key: Key, default: Any) -> None:
        if key in self.entries:
            return
        if isinstance(value, Mapping) and value and any(read[: len(key)] == key for read in self.entries):
            for name, item in value.items():
                self._mark_unread(item, (*key, str(name)), default.get(name) if isinstance(default, Mapping) else None)
        elif is_empty(value) or (default is not None and equals_default(value, default)):
            self.entries[key] = ("default", "")
        else:
            self.entries[key] = ("ignored", "")


class Node:
    """Dict of settings at one place of the configuration. Reading one of its keys marks the key in the report.

    Args:
        data: the settings.
        key: the place, as the path of keys from the top.
        report: receives how the keys were translated.
    """

    def __init__(self, data: Mapping[str, Any], key: Key, report: Report) -> None:
        self.data, self.key, self.report = data, key, report

    def __contains__(self, name: str) -> bool:
        value = self.data.get(name)
        return value is not None and not is_missing(value)

    def get(self, name: str, default: Any = None) -> Any:
        """Return the value of a key and mark the key as mapped; return `default` if the value is None or missing.

        An array or a tensor is returned as lists of numbers.
        """
        if name in self.data:
            self.report.entries.setdefault((*self.key, name), ("mapped", ""))
        value = _without_array(self.data.get(name))
        return default if value is None or is_missing(value) else value

    def require(self, name: str) -> Any:
        """Return the value of a key; if it is None or missing, report a mistake and return None."""
        value = self.get(name)
        if value is None:
            self.report.problem(self.key, f"missing '{name}'; give it a value")
        return value

    def node(self, name: str) -> Node:
        """Return the dict of settings under a key as a `Node`; an empty one if the key has no value."""
        value = self.data.get(name)
        if value is None or is_missing(value):
            self.get(name)
            value = {}
        if not isinstance(value, Mapping):
            kind = type(value).__name__
            hint = None if type(value).__module__ == "builtins" else f"write @configclass above the class {kind}"
            self.report.problem((*self.key, name), f"expected a configuration object, found a {kind}", hint)
            value = {}
        return Node(value, (*self.key, name), self.report)

    def nodes(self) -> Iterator[tuple[str, Node]]:
        """Yield (key, settings) for every key whose value is a dict."""
        for name, value in self.data.items():
            if isinstance(value, Mapping):
                yield name, Node(value, (*self.key, name), self.report)

    def note(self, status: Status, name: str, why: str = "") -> None:
        """Record how a key was translated, with the reason `why`, unless its value is empty."""
        if name in self and not is_empty(self.data[name]):
            self.report.entries[(*self.key, name)] = (status, why)

    def mark_mapped(self, *names: str) -> None:
        """Record keys as mapped without reading them here.

        Their values are read elsewhere, or they have no effect on the simulation, such as colours of markers.
        """
        for name in names:
            if name in self.data:
                self.report.entries[(*self.key, name)] = ("mapped", "")


def kind_of(value: Any) -> str:
    """Return the name, without module, of a class, a function, an object's class or a reference `module:Name`."""
    if value is None or is_missing(value):
        return ""
    name = value if isinstance(value, str) else getattr(value, "__name__", type(value).__name__)
    return name.rpartition(":")[2].rpartition(".")[2] or name.rpartition(":")[2]


def base_kind(settings: Mapping[str, Any]) -> tuple[str, bool]:
    """Return the name of Isaac Lab's class of an asset or sensor, and whether the task's own class derives from it."""
    class_type = settings.get("class_type")
    for base in class_type.__mro__ if isinstance(class_type, type) else ():
        if base.__module__.startswith("rlcli_isaaclab"):
            key, kind, other = _FACADES.get(base.__name__, ("class_type", base.__name__, ""))
            return kind if key in settings else other, base is not class_type
    return kind_of(class_type), False


_FACADES = {
    "Asset": ("actuators", "Articulation", "RigidObject"),
    "CameraView": ("data_types", "Camera", "Camera"),
    "Sensor": ("pattern_cfg", "RayCaster", "ContactSensor"),
}
"""Class that stands for two of Isaac Lab's -> (a setting, Isaac Lab's class with the setting, the one without it)."""


def _without_array(value: Any) -> Any:
    """Return an array or a tensor as lists of numbers, and any other value unchanged."""
    return value.tolist() if isinstance(value, np.ndarray | np.generic | torch.Tensor) else value


def to_plain(value: Any) -> Any:
    """Return a setting in a form that a YAML task can hold.

    Arrays, tensors and tuples become lists, and infinities become +-1e9.
    """
    value = _without_array(value)
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_plain(item) for item in value]
    if isinstance(value, float) and math.isinf(value):
        return math.copysign(1e9, value)
    return value


def as_float(value: Any) -> Any:
    """Return an integer as a float, and any other value unchanged."""
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def is_empty(value: Any) -> bool:
    """Return whether a setting is None, missing, False, "" or an empty list, or a dict that has only such values."""
    if isinstance(value, Mapping):
        return all(is_empty(item) for item in value.values())
    value = _without_array(value)
    return (
        value is None or is_missing(value) or value is False or value in ("", slice(None)) or value == [] or value == ()
    )


def equals_default(value: Any, default: Any) -> bool:
    """Return whether a setting equals its default. A list, a tuple and an array with equal items are equal."""
    value, default = _without_array(value), _without_array(default)
    if isinstance(value, list | tuple) and isinstance(default, list | tuple):
        return len(value) == len(default) and all(equals_default(a, b) for a, b in zip(value, default, strict=True))
    return bool(value == default)

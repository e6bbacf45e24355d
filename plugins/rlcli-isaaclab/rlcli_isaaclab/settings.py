"""Isaac Lab's settings as nested dicts, read key by key: what nobody asks for is reported."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from rlcli.errors import ConfigError, Problem
from rlcli.formats import Note, Status
from rlcli_isaaclab.config_class import is_missing

Key = tuple[str, ...]


@dataclass(slots=True)
class Report:
    """What became of each key."""

    entries: dict[Key, tuple[Status, str]] = field(default_factory=dict)
    """Key -> mapped, approximated or ignored, and why."""
    problems: list[Problem] = field(default_factory=list)
    stubs: dict[str, tuple[str, dict[str, Any]]] = field(default_factory=dict)
    """Functions that only their author has: name -> section and parameters."""

    def notes(self, prefix: str = "", where: str = "") -> list[Note]:
        """What became of each key."""
        start = f"{prefix}." if prefix else ""
        return [Note(where, start + ".".join(key), *what) for key, what in self.entries.items()]

    def news(self, prefix: str = "") -> list[Note]:
        """What a user should know: everything that is not simply mapped."""
        return [note for note in self.notes(prefix) if note.status not in ("mapped", "default")]

    def problem(self, key: Key, message: str, hint: str | None = None) -> None:
        """Note a mistake."""
        self.problems.append(Problem("configuration", ".".join(key), message, hint))

    def finish(self, data: Any, defaults: Any = None) -> None:
        """Whatever nobody asked for is ignored; what is not set, or as it always is, is a default."""
        self._finish(data, (), defaults)
        if self.problems:
            raise ConfigError(self.problems)

    def _finish(self, value: Any, key: Key, default: Any) -> None:
        if key in self.entries:
            return
        if isinstance(value, Mapping) and value and any(known[: len(key)] == key for known in self.entries):
            for name, item in value.items():
                self._finish(item, (*key, str(name)), default.get(name) if isinstance(default, Mapping) else None)
        elif is_empty(value) or (default is not None and alike(value, default)):
            self.entries[key] = ("default", "")
        else:
            self.entries[key] = ("ignored", "")


class Node:
    """A mapping of settings; what is asked for counts as mapped."""

    def __init__(self, data: Mapping[str, Any], key: Key, report: Report) -> None:
        self.data, self.key, self.report = data, key, report

    def __contains__(self, name: str) -> bool:
        value = self.data.get(name)
        return value is not None and not is_missing(value)

    def get(self, name: str, default: Any = None) -> Any:
        """A value, taken over."""
        if name in self.data:
            self.report.entries.setdefault((*self.key, name), ("mapped", ""))
        value = self.data.get(name)
        return default if value is None or is_missing(value) else value

    def need(self, name: str) -> Any:
        """A value that must be there."""
        value = self.get(name)
        if value is None:
            self.report.problem(self.key, f"missing '{name}'")
        return value

    def node(self, name: str) -> Node:
        """What stands under a name; empty if nothing does."""
        value = self.data.get(name)
        if value is None or is_missing(value):
            self.get(name)
            value = {}
        if not isinstance(value, Mapping):
            kind = type(value).__name__
            hint = None if type(value).__module__ == "builtins" else f"write @configclass above the class {kind}"
            self.report.problem((*self.key, name), f"expected settings, found a {kind}", hint)
            value = {}
        return Node(value, (*self.key, name), self.report)

    def nodes(self) -> Iterator[tuple[str, Node]]:
        """Every member that has settings."""
        for name, value in self.data.items():
            if isinstance(value, Mapping):
                yield name, Node(value, (*self.key, name), self.report)

    def say(self, status: Status, name: str, why: str = "") -> None:
        """Report a member, if it is set to something."""
        if name in self and not is_empty(self.data[name]):
            self.report.entries[(*self.key, name)] = (status, why)

    def skip(self, *names: str) -> None:
        """Members that mean nothing outside Isaac Sim, and change nothing that matters here."""
        for name in names:
            if name in self.data:
                self.report.entries[(*self.key, name)] = ("mapped", "")


def kind_of(value: Any) -> str:
    """The last word of a class or function, given as such or as `module:Name`."""
    if value is None or is_missing(value):
        return ""
    name = value if isinstance(value, str) else getattr(value, "__name__", type(value).__name__)
    return name.rpartition(":")[2].rpartition(".")[2] or name.rpartition(":")[2]


def numbers(value: Any) -> Any:
    """Tuples as lists, without infinities."""
    if isinstance(value, Mapping):
        return {str(key): numbers(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [numbers(item) for item in value]
    if isinstance(value, float) and math.isinf(value):
        return math.copysign(1e9, value)
    return value


def as_float(value: Any) -> Any:
    """A whole number as a float; anything else as it is."""
    return float(value) if isinstance(value, int) and not isinstance(value, bool) else value


def is_empty(value: Any) -> bool:
    """Whether a setting, with all below it, says nothing."""
    if isinstance(value, Mapping):
        return all(is_empty(item) for item in value.values())
    return (
        value is None or is_missing(value) or value is False or value in ("", slice(None)) or value == [] or value == ()
    )


def alike(value: Any, default: Any) -> bool:
    """Whether a setting says what its default says, be it a list or a tuple."""
    if isinstance(value, list | tuple) and isinstance(default, list | tuple):
        return len(value) == len(default) and all(alike(a, b) for a, b in zip(value, default, strict=True))
    return bool(value == default)

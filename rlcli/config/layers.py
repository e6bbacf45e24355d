"""Merging of the sources of a configuration (task, agent, --config file, command line) before it is validated.

Each source is one layer; later layers win. Every value keeps its origin: the file and line that it was written in.
"""

import copy
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

from rlcli.config import strict_yaml
from rlcli.config.strict_yaml import Document, Path, YamlError
from rlcli.errors import ConfigError, Problem
from rlcli.machine.plain_files import read_plain
from rlcli.safe_text import shorten

_KEY = re.compile(r'"([^"]+)"|([^.="\s]+)')
_OVERRIDE = re.compile(rf"\s*((?:{_KEY.pattern})(?:\.(?:{_KEY.pattern}))*)\s*=(.*)", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Origin:
    """Origin of a value of a configuration: which source set it, and where.

    `layer` is the kind of source: task (the task's file), agent (`task:` of an agent), play (`play:` of the task),
    config (the `--config` file), override, flag or settings (the user's settings file). `where` is `file:line:column`,
    the text of an override, or a flag.
    """

    layer: str
    where: str


@dataclass(slots=True)
class Layers:
    """Configuration merged from several sources: the data, and the origin of the value at every path (its keys)."""

    data: dict[str, Any] = field(default_factory=dict)
    origins: dict[Path, Origin] = field(default_factory=dict)

    def merge(self, patch: Mapping[str, Any], origin: Callable[[Path], Origin], at: Path = ()) -> None:
        """Merge a patch into the data at path `at`: mappings key by key, all other values are replaced.

        `origin(path)` returns the origin of the value at that path of the patch.
        """
        self.origins.setdefault((), origin(()))
        self._merge(patch, origin, at, ())

    def _merge(self, patch: Mapping[str, Any], origin: Callable[[Path], Origin], at: Path, inner: Path) -> None:
        target = self._mapping(at, origin(inner))
        for key, value in patch.items():
            path, source = (*at, key), (*inner, key)
            if isinstance(value, dict) and isinstance(target.get(key), dict):
                self._merge(value, origin, path, source)
                continue
            if key in target:
                self._forget(path, target[key])
            target[key] = copy.deepcopy(value)
            for below in _paths(value):
                self.origins[path + below] = origin(source + below)

    def set(self, path: Path, value: object, origin: Origin) -> None:
        """Set one value, as an override does. Missing mappings on the path are created.

        Raises:
            LookupError: if the path leads into a value that is not a mapping, or to a list item that does not exist.
        """
        target: Any = self.data
        taken: Path = ()
        for step in path[:-1]:
            target, taken = self._descend(target, step, taken, origin)
        last: str | int = path[-1]
        if isinstance(target, list):
            last = _index(target, last, taken)
            old = target[last]
        elif not isinstance(target, dict):
            raise LookupError(f"'{taken[-1]}' is a single value; leave out the keys after it")
        else:
            old = target.get(last)
        taken = (*taken, last)
        self._forget(taken, old)
        target[last] = value
        for below in _paths(value):
            self.origins[taken + below] = origin

    def get(self, path: Path, default: object = None) -> Any:
        """Return the value at a path, or `default` if there is none."""
        value: Any = self.data
        for step in path:
            if not isinstance(value, dict) or step not in value:
                return default
            value = value[step]
        return value

    def origin(self, path: Path) -> Origin | None:
        """Return the origin of the value at a path, or of the nearest value that contains it; None if there is none."""
        for length in range(len(path), -1, -1):
            if path[:length] in self.origins:
                return self.origins[path[:length]]
        return None

    def place(self, path: Path) -> str:
        """Return where the value at a path was written, for a message: `file:line:column`, an override or a flag."""
        origin = self.origin(path)
        return origin.where if origin else "configuration"

    def _descend(self, target: object, step: str | int, taken: Path, origin: Origin) -> tuple[Any, Path]:
        """Return the member `step` of a mapping or list, and its path; create a missing member as an empty mapping.

        Args:
            target: the mapping or list.
            step: key or index of the member.
            taken: path of `target`.
            origin: origin of a member that is created.
        """
        if isinstance(target, list):
            index = _index(target, step, taken)
            return target[index], (*taken, index)
        if not isinstance(target, dict):
            raise LookupError(f"'{taken[-1]}' is a single value; leave out the keys after it")
        path = (*taken, step)
        if target.get(str(step)) is None:
            target[str(step)] = {}
            self.origins[path] = origin
        return target[str(step)], path

    def _mapping(self, path: Path, origin: Origin) -> dict[str, Any]:
        """Return the mapping at a path; create it, and replace values on the path that are not mappings."""
        target = self.data
        for depth, step in enumerate(path):
            if not isinstance(target.get(str(step)), dict):
                target[str(step)] = {}
                self.origins[path[: depth + 1]] = origin
            target = target[str(step)]
        return target

    def _forget(self, path: Path, value: object) -> None:
        """Remove the origins of the value at a path."""
        for below in _paths(value):
            self.origins.pop(path + below, None)


def read(file: FilePath, name: str | None = None, *, pipe: bool = False) -> Document:
    """Read a strict YAML file.

    Args:
        file: the file.
        name: name of the file in messages; None: its path.
        pipe: whether the file may be a pipe, as a shell creates it for `--config <(...)`.

    Raises:
        ConfigError: if the file cannot be read or parsed, with the position of the mistake.
    """
    name = name or str(file)
    try:
        return strict_yaml.load(read_plain(file, strict_yaml.MAX_BYTES, pipe=pipe))
    except OSError as error:
        raise ConfigError(
            [Problem(name, "", f"the file cannot be read: {error.strerror or error}; check the path")]
        ) from None
    except YamlError as error:
        place = f"{name}:{error.line}:{error.column}" if error.line else name
        raise ConfigError([Problem(place, "", error.message)]) from None


def document_origins(document: Document, name: str, layer: str, at: Path = ()) -> Callable[[Path], Origin]:
    """Return a function that maps the path of a value in a parsed file to its origin: layer, file, line and column.

    The paths that the function takes are relative to `at`.

    Args:
        document: the parsed file.
        name: name of the file.
        layer: kind of source, as in `Origin`.
        at: path in the document at which the values are.
    """

    def origin(path: Path) -> Origin:
        full = at + path
        while full not in document.marks and full:
            full = full[:-1]
        if not document.marks:  # a configuration in Python has no lines
            return Origin(layer, name)
        line, column = document.marks[full]
        return Origin(layer, f"{name}:{line}:{column}")

    return origin


def flags(**values: Any) -> dict[str, Any]:
    """Return the flags that are not None, by dotted key (the argument `scene__num_envs` is `scene.num_envs`)."""
    return {key.replace("__", "."): value for key, value in values.items() if value is not None}


def leaves(value: object, path: Path = ()) -> Iterator[tuple[Path, Any]]:
    """Yield every value in nested mappings with its path. An empty mapping counts as a value."""
    if isinstance(value, Mapping) and value:
        for key, item in value.items():
            yield from leaves(item, (*path, key))
    else:
        yield path, value


def parse_override(text: str) -> tuple[Path, Any]:
    """Return path and value of an override such as `rewards.alive.weight=2`.

    A key that contains a dot is written in quotes: `joints.".*".damping=1`.

    Raises:
        ConfigError: if the text is not of the form key.path=value, or the value is not YAML.
    """
    where = override_place(text)
    match = _OVERRIDE.fullmatch(text)
    if match is None:
        raise ConfigError(
            [Problem(where, "", "an override has the form KEY.PATH=VALUE; write for example scene.num_envs=64")]
        )
    path = parse_address(match[1])
    if len(path) > strict_yaml.MAX_DEPTH:
        message = f"the key has {len(path)} parts; at most {strict_yaml.MAX_DEPTH} are allowed"
        raise ConfigError([Problem(where, "", message)])
    try:
        return path, strict_yaml.load_value(match[match.lastindex or 0])
    except YamlError as error:
        raise ConfigError([Problem(where, ".".join(path), error.message)]) from None


def override_place(text: str) -> str:
    """Return the location of a mistake in an override, for messages: `override 'KEY.PATH=VALUE'`, shortened."""
    return f"override '{shorten(text, 150)}'"


def parse_address(text: str) -> tuple[str, ...]:
    """Return the keys of a dotted key such as `rewards.alive.weight`. A key that contains a dot is in quotes."""
    return tuple(quoted or plain for quoted, plain in _KEY.findall(text))


def without(data: Any, paths: Iterable[Path]) -> Any:
    """Return a copy of nested mappings with None instead of the values at these paths.

    The caller validates those values separately, with their own models.
    """
    inner: dict[Any, list[Path]] = {}
    for path in paths:
        if path == ():
            return None
        inner.setdefault(path[0], []).append(path[1:])
    return {k: without(v, inner[k]) if k in inner else v for k, v in data.items()} if inner else data


def _index(target: list[Any], step: str | int, taken: Path) -> int:
    if not str(step).isdecimal() or int(step) >= len(target):
        allowed = f"give an index from 0 to {len(target) - 1}" if target else "the list has no items"
        raise LookupError(f"'{taken[-1]}' is a list of length {len(target)} without item '{step}'; {allowed}")
    return int(step)


def _paths(value: object) -> list[Path]:
    """Return the paths of a value and of everything inside it, lists included."""
    if isinstance(value, dict):
        return [(), *((key, *below) for key, item in value.items() for below in _paths(item))]
    if isinstance(value, list):
        return [(), *((index, *below) for index, item in enumerate(value) for below in _paths(item))]
    return [()]

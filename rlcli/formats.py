"""Interface for plugins that read the task files of other frameworks.

A plugin declares a `FormatSpec`; the functions that the `FormatSpec` names return a `Translation` or an `Imported`,
with a `Note` for each key of the other framework's file.

Types of other modules: [`TaskSource`](registry.md#tasksource) has the name, the folder and the files of a task;
`Document` (`rlcli.config.strict_yaml`) is a parsed YAML file, with the line and column of each key; `Origin`
(`rlcli.config.layers`) is the place where a value was set, such as `file:line:column`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rlcli.task import API_VERSION, require_field_types

if TYPE_CHECKING:
    from rlcli.config.layers import Origin

_log = logging.getLogger(__name__)

Status = Literal["mapped", "approximated", "ignored", "task", "default", "to do"]
"""How a key was translated. mapped: exactly; approximated: with a difference; ignored: not at all; task: not, because
the task's own class reads the key; default: not, because the key has its default value; to do: not yet, the user must
translate the key."""


@dataclass(frozen=True, slots=True)
class FormatSpec:
    """A format of task files of another framework. An entry point of the group `rlcli.formats` names such an object.

    The module that defines the object must be cheap to import. The format's name is the name of the entry point. The
    attributes `find`, `read`, `check`, `environment`, `importer`, `hint`, `agents_beside` and `agent_file` are
    references `module:name` to a function or class with the given signature, which is imported at its first use. An
    empty string means that the format does not have this part.

    Attributes:
        summary: the tasks that the format describes, for messages, for example `tasks of LIBRARY`.
        find: `(path: Path) -> TaskSource | None`. Return the task of a folder or file in this format, without importing
            code of the task; None for a path of another format.
        read: `(document: Document, source: TaskSource) -> Translation | None`. Translate a YAML document of this format
            into the data of a task; None for a document of another format.
        key: a top-level key of task files, such as `isaaclab:`. Only the format's environment reads its content.
        check: `(block: Mapping) -> Iterable[(path, message, hint)]`. Yield the mistakes in `block`, the content of
            `key`; `path` has the keys from the block to the wrong value.
        open_scene: whether a task file may have no entities, because the format's environment adds entities.
        environment: the `VecEnv` class that runs a task whose file has content at `key`.
        importer: the function of the command `rlcli import NAME`, which returns an `Imported`. Its parameters have
            Typer's annotations.
        hint: `(error: BaseException) -> str | None`. Return what the user can do about an error of a task's code; None
            if unknown.
        agents_beside: `(folder: Path) -> Iterable[Path]`. Yield the Python files that may define agents for a task
            whose configuration is in the folder.
        models: dotted key of the task that `--model NAME=FILE` sets, with `{name}` in the place of NAME. Empty: the
            configuration is a Python object whose method `__rlcli_task__(root: Path, models: Mapping)` returns the
            content of a `task.yaml`; `root` is the folder of the task, `models` has NAME -> FILE.
        agent_file: `(file: Path, library: str, notes: list[Note]) -> dict | None`. Return the settings of an agent
            that a registration with Gymnasium names by a file; None if the format does not read the library's files.
        agent_order: names of training libraries, preferred first. If a registration with Gymnasium has agents of
            several libraries, the default agent is that of the first library in this order.
        aliases: name of a module of the framework -> name of the module that replaces it in imports of task files, or
            -> `module:function`. Submodules are replaced, too. `function(name, file)` returns the module for the full
            name `name` that `file` imports, or None.
        libraries: those keys of `aliases` that are general libraries, such as numpy. An import of a library does not
            show that a task file belongs to this format; an import of another key of `aliases` does.
        api: the version of this interface, `rlcli.task.API_VERSION`, that the format was written for.
    """

    summary: str
    find: str = ""
    read: str = ""
    key: str = ""
    check: str = ""
    open_scene: bool = False
    environment: str = ""
    importer: str = ""
    hint: str = ""
    agents_beside: str = ""
    models: str = ""
    agent_file: str = ""
    agent_order: tuple[str, ...] = ()
    aliases: Mapping[str, str] = field(default_factory=dict)
    libraries: tuple[str, ...] = ()
    api: int = API_VERSION

    def __post_init__(self) -> None:
        require_field_types(self)


@dataclass(slots=True)
class Translation:
    """Result of a format's `read`: a task file of another framework, translated into the data of an rlcli task."""

    data: dict[str, Any]
    """Content of an equivalent `task.yaml`."""
    origin: Callable[[tuple[str | int, ...]], Origin]
    """Function from a path in `data` (keys and list indices) to the place in the source file that sets the value."""
    notes: list[Note]
    """How each key was translated."""
    agents: dict[str, Any] = field(default_factory=dict)
    """Agents that `read` found in a separate file: name of an agent -> its settings."""
    agents_origin: Callable[[tuple[str | int, ...]], Origin] | None = None
    """Function like `origin`, for the paths in `agents`; None: no agents were read from a separate file."""

    def __post_init__(self) -> None:
        notes_are = isinstance(self.notes, list) and all(isinstance(note, Note) for note in self.notes)
        if not isinstance(self.data, dict) or not isinstance(self.agents, dict) or not notes_are:
            raise TypeError("data and agents of a Translation must be dicts, notes a list of Notes")
        if not callable(self.origin) or not (self.agents_origin is None or callable(self.agents_origin)):
            raise TypeError("origin and agents_origin of a Translation must be functions")


@dataclass(slots=True)
class Imported:
    """Result of `rlcli import`: the written files, and a note for each key of the other framework's file."""

    folder: Path
    """Folder of the new task."""
    files: list[Path]
    """Files that were written."""
    notes: list[Note]
    """How each key was translated."""
    messages: list[str] = field(default_factory=list)
    """Messages to print, about what the user still has to do by hand."""


@dataclass(frozen=True, slots=True)
class Note:
    """How a key of another framework's file was translated."""

    where: str
    """File and line of the key; empty if unknown."""
    key: str
    """Dotted key in the other framework's file."""
    status: Status
    """How the key was translated, in one word."""
    text: str = ""
    """What the key was translated to, or which effect of the key is lost; may be empty."""
    agent: str = ""
    """Name of the agent whose settings have the key; empty for a key of the task."""

    def __str__(self) -> str:
        """Return the note on one line: place, key, status, text."""
        status = "read by the task's class" if self.status == "task" else self.status
        where = f"{self.where}: " if self.where else ""
        text = f": {self.text}" if self.text else ""
        return f"{where}{self.key}: {status}{text}"


def summary(notes: Iterable[Note]) -> list[str]:
    """Return the lines `mapped: KEYS`, `approximated: KEYS` and `ignored: KEYS` for notes; no line without keys."""
    lines, notes = [], list(notes)
    for status in ("mapped", "approximated", "ignored"):
        parents: dict[str, list[str]] = {}
        for note in notes:
            if note.status == status:
                parent, _, key = note.key.rpartition(".")
                if key not in parents.setdefault(parent, []):
                    parents[parent].append(key)
        groups = [f"{parent}.{{{', '.join(keys)}}}" if parent else ", ".join(keys) for parent, keys in parents.items()]
        if groups:
            lines.append(f"{status}: {', '.join(groups)}")
    return lines


def log_notes(notes: Iterable[Note]) -> None:
    """Log how the keys of another framework's file were translated.

    The lines of `summary` are logged at level INFO, each note at level DEBUG.
    """
    notes = list(notes)
    for line in summary(notes):
        _log.info(line)
    for note in notes:
        _log.debug(note)

"""What a plugin exports that reads the task files of another framework, and what such a reader reports."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rlcli.task import API_VERSION

if TYPE_CHECKING:
    from rlcli.config.layers import Origin

_log = logging.getLogger(__name__)

Status = Literal["mapped", "approximated", "ignored", "task", "default", "to do"]
"""task: read by the task's own class; default: as it always is; to do: left to the user."""


@dataclass(frozen=True, slots=True)
class FormatSpec:
    """What an entry point of the group `rlcli.formats` resolves to. Importing its module must be cheap.

    The format's name is the entry point's name. Every reference is `module:name` and is imported when it is used; an
    empty one means that the format has no such part.

    Attributes:
        summary: what the format is of, for messages, as in `tasks of LIBRARY`.
        find: `(path: Path) -> TaskSource | None`, the task of a folder or file in this format. No code of the task is
            imported.
        read: `(document: Document, source: TaskSource) -> Translation | None`, a YAML document of this format as the
            data of a task; None for a document of another format.
        key: the top-level key of a task file that holds what only the format's environment reads.
        check: `(block: Mapping) -> Iterable[(path, message, hint)]`, mistakes in what stands at `key`.
        open_scene: the format's environment adds entities to the scene, so a task file need not name any.
        environment: the `VecEnv` class that runs a task with something at `key`.
        importer: the function of the command `rlcli import NAME`, which returns an `Imported`. Its parameters are
            annotated as Typer's are.
        hint: `(error: BaseException) -> str | None`, what to do about an error of a task's code.
        agents_beside: `(folder: Path) -> Iterable[Path]`, Python files that may hold the agents of a configuration.
        aliases: module name -> module. While a task's files are imported, the first name (and names below it) resolves
            to the second.
        api: the `API_VERSION` the format was written for.
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
    aliases: Mapping[str, str] = field(default_factory=dict)
    api: int = API_VERSION


@dataclass(slots=True)
class Translation:
    """A task of another format as the data of a task."""

    data: dict[str, Any]
    origin: Callable[[tuple[str | int, ...]], Origin]
    """Path in `data` -> where it was written."""
    notes: list[Note]
    agents: dict[str, Any] = field(default_factory=dict)
    """Agents from a file of their own."""
    agents_origin: Callable[[tuple[str | int, ...]], Origin] | None = None


@dataclass(slots=True)
class Imported:
    """The result of an importer: the files that it wrote, and what became of each key of the source."""

    folder: Path
    files: list[Path]
    notes: list[Note]
    messages: list[str] = field(default_factory=list)
    """What is left to do."""


@dataclass(frozen=True, slots=True)
class Note:
    """What became of a key."""

    where: str
    """File and line, as far as they are known."""
    key: str
    status: Status
    text: str = ""

    def __str__(self) -> str:
        """Return the note on one line."""
        status = "read by the task's class" if self.status == "task" else self.status
        place = f"{self.where}: " if self.where else ""
        return f"{place}{self.key}: {status}{f': {self.text}' if self.text else ''}"


def summary(notes: Iterable[Note]) -> list[str]:
    """Return the notes in a few lines, one for each status."""
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
    """Log what became of the keys of a configuration in another format: a summary, and each note at debug level."""
    notes = list(notes)
    for line in summary(notes):
        _log.info(line)
    for note in notes:
        _log.debug(note)

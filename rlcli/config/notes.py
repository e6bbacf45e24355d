"""What became of the keys of a configuration in another tool's form."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

Status = Literal["mapped", "approximated", "ignored", "task", "default", "to do"]
"""task: read by the task's own class; default: as it always is; to do: left to the user."""


@dataclass(frozen=True, slots=True)
class Note:
    """What became of a key."""

    where: str
    """File and line, as far as they are known."""
    key: str
    status: Status
    text: str = ""

    def __str__(self) -> str:
        """One line."""
        said = "read by the task's class" if self.status == "task" else self.status
        place = f"{self.where}: " if self.where else ""
        return f"{place}{self.key}: {said}{f': {self.text}' if self.text else ''}"


def summary(notes: Iterable[Note]) -> list[str]:
    """The notes in a few lines, one a status."""
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

"""What an importer gives back."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from rlcli.config.notes import Note


@dataclass(slots=True)
class Imported:
    """Files that were written, and what became of each key of the source."""

    folder: Path
    files: list[Path]
    notes: list[Note]
    messages: list[str] = field(default_factory=list)
    """What is left to do."""

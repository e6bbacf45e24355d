"""A task that was found, wherever it was: what everything that reads, checks and builds it needs to know."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class TaskSource:
    """A task that was found: its name, its files, and what imports its code."""

    name: str
    root: Path
    config: Path
    distribution: str | None
    version: str | None
    term_files: tuple[Path, ...]
    term_modules: tuple[str, ...]
    task: str | None
    task_file: Path | None
    python: str | None = None
    """`module:attribute`, `file.py:attribute` or a package's folder that holds the configuration, if Python does."""
    agents: tuple[tuple[str, str], ...] = ()
    """Further agents of a configuration in Python: (name, `module:attribute`)."""
    value: Any = None
    """The configuration itself, where it exists in memory only."""
    policy: Path | None = None
    """The folder of the policy that is shipped with the task; None: none is."""

    @property
    def label(self) -> str:
        """How messages name the file."""
        try:
            return str(self.config.relative_to(Path.cwd()))
        except ValueError:
            return str(self.config)

    def record(self) -> dict[str, str | None]:
        """What a run stores to find the task again."""
        folder = None if self.distribution else str(self.root)
        record = {"name": self.name, "distribution": self.distribution, "version": self.version, "folder": folder}
        return record | ({"python": self.python} if self.python and folder else {})

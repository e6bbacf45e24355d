"""Data class `TaskSource`, the location of a task: the files and modules from which it is read, checked and built.

The registry returns it for a task's name; the configuration and the environment are built from it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class TaskSource:
    """Location of a task: its name, its files, and the references (`module:name`) by which its code is imported."""

    name: str
    """Name of the task, as on the command line."""
    root: Path
    """Folder of the task; paths in its configuration are relative to this folder."""
    config: Path
    """File with the task's configuration."""
    distribution: str | None = None
    """Installed distribution that has the task; None for a task in a folder."""
    version: str | None = None
    """Version of the distribution."""
    term_files: tuple[Path, ...] = ()
    """Files with the task's own terms."""
    term_modules: tuple[str, ...] = ()
    """Modules to import the terms of `term_files` from, in the same order."""
    task: str | None = None
    """Class of a direct task, `module:Class` or `file.py:Class`; None for a manager-based task."""
    task_file: Path | None = None
    """File with the class of a direct task; None for a manager-based task."""
    python: str | None = None
    """Configuration in Python: `module:attribute`, `file.py:attribute` or the folder of a package; None: YAML."""
    agents: tuple[tuple[str, str], ...] = ()
    """Further agents of a configuration in Python: (name, `module:attribute`)."""
    value: Any = None
    """The configuration itself, if it exists in memory only."""
    policy: Path | None = None
    """The folder of the trained policy that is shipped with the task; None: there is none."""

    shown: Path | None = None
    """File that messages name, if `config` is a temporary copy of a part of it; None: `config`."""

    @property
    def label(self) -> str:
        """Name of the configuration file in messages: relative to the current folder if possible."""
        file = self.shown or self.config
        try:
            return str(file.relative_to(Path.cwd()))
        except ValueError:
            return str(file)

    @property
    def without_terms_hint(self) -> str:
        """First part of the hint for an unknown term: why a task in YAML has no own terms; else empty."""
        if self.term_files or self.python is not None or self.value is not None:
            return ""
        if self.distribution is None:
            return f"the folder {self.root.name} has no terms.py; "
        if (self.root / "terms.py").is_file():
            return "terms.py is beside the YAML, but TaskSpec.terms does not name it: add terms=('PACKAGE.terms',); "
        return "TaskSpec.terms names no module with own terms; "

    def record(self) -> dict[str, str | None]:
        """Return what `run.json` stores to find the task again: name, distribution and version, or the folder."""
        folder = None if self.distribution else str(self.root)
        record = {"name": self.name, "distribution": self.distribution, "version": self.version, "folder": folder}
        return record | ({"python": self.python} if self.python and folder else {})


def task_reference(record: Mapping[str, Any]) -> str:
    """Return the text by which a command line names a recorded task (`TaskSource.record`), with the ID of a package."""
    if record.get("distribution") or not (record.get("python") or record.get("folder")):
        return str(record["name"])
    file = record.get("file") or "task.yaml"
    return str(record.get("python") or (record["folder"] if file == "task.yaml" else Path(record["folder"]) / file))

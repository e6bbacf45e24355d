"""Base class of the translators of OmniIsaacGymEnvs' YAML files. It records values, sources, notes and mistakes."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from rlcli.config.layers import Origin, document_origins
from rlcli.config.strict_yaml import Document, Path
from rlcli.errors import Problem
from rlcli.formats import Note, Status
from rlcli_oige.hydra_defaults import label_at


@dataclass(slots=True)
class YamlTranslator:
    """Base class of a translator of one YAML file: translated settings, and notes and mistakes for the user."""

    document: Document
    label: str
    """Name of the file in messages."""
    data: dict[str, Any] = field(default_factory=dict)
    """Translated settings."""
    sources: dict[Path, Path] = field(default_factory=dict)
    """Key of a translated setting -> key of the file."""
    notes: list[Note] = field(default_factory=list)
    """How each key of the file was translated, from `note`."""
    problems: list[Problem] = field(default_factory=list)
    """Mistakes in the file, from `problem`."""

    def put(self, target: Path, value: Any, source: Path) -> None:
        """Set the translated setting `target` to a value, and record the key `source` of the file it comes from."""
        node = self.data
        for step in target[:-1]:
            node = node.setdefault(str(step), {})
        node[str(target[-1])] = value
        self.sources[target] = source

    def where(self, path: Path) -> str:
        """Return `file:line:column` of a key."""
        return self.origin(path).where

    def origin(self, path: Path) -> Origin:
        """Return the file and line of a key."""
        return document_origins(self.document, label_at(self.document, path, self.label), "task")(path)

    def note(self, path: Path, status: Status, text: str = "") -> None:
        """Record how a key was translated.

        Args:
            path: path of the key in the file.
            status: mapped, approximated, ignored, or task (the task's class reads it).
            text: where the value went, or why it has no effect.
        """
        self.notes.append(Note(self.where(path), ".".join(str(step) for step in path), status, text))

    def problem(self, path: Path, message: str, hint: str | None = None) -> None:
        """Record a mistake at the key with this path in the file."""
        self.problems.append(Problem(self.where(path), ".".join(str(step) for step in path), message, hint))

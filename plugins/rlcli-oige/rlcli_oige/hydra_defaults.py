"""Composition of a task's YAML from the files of its Hydra `defaults:` list."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path as FilePath
from typing import Any

from rlcli.config.layers import document_origins, read
from rlcli.config.strict_yaml import Document, Path
from rlcli.errors import ConfigError, Problem, listing

DEFAULTS = "defaults"
_SELF = "_self_"


@dataclass(slots=True)
class Composed(Document):
    """A parsed YAML document that is merged from several files."""

    labels: dict[Path, str] = field(default_factory=dict)
    """Path of a key -> name of the file that sets the key."""


def compose(document: Document, file: FilePath, label: str) -> Document:
    """Return a document with its `defaults:` list replaced by the content of the listed files.

    Entries are merged in the order of the list. `_self_` stands for the document itself; without this entry the
    document is merged last. A name means a YAML file beside the document, `/name` a YAML file in the folder above.

    Raises:
        ConfigError: if an entry names no such file, or a file lists itself.
    """
    if DEFAULTS not in document.data:
        return document
    result = Composed({})
    for part, name in _parts(document, file, label, (file.resolve(),)):
        _merge(result.data, {key: value for key, value in part.data.items() if key != DEFAULTS})
        for path, mark in part.marks.items():
            if path[:1] != (DEFAULTS,):
                result.marks[path], result.labels[path] = mark, name
    return result


def label_at(document: Document, path: Path, label: str) -> str:
    """Return the name, for messages, of the YAML file that sets the key at a path.

    Args:
        document: the YAML, which may be composed of several files.
        path: path of the key.
        label: name of the file if the document is not composed.
    """
    if not isinstance(document, Composed):
        return label
    while path and path not in document.labels:
        path = path[:-1]
    return document.labels.get(path, label)


def _parts(
    document: Document, file: FilePath, label: str, active: tuple[FilePath, ...]
) -> Iterator[tuple[Document, str]]:
    """Yield the documents to merge, in order, each with the name of its file."""
    entries = document.data.get(DEFAULTS, [_SELF])
    where = document_origins(document, label, "task")
    if not isinstance(entries, list):
        message = f"expected a list of file names, found {entries!r}"
        raise ConfigError([Problem(where((DEFAULTS,)).where, DEFAULTS, message, "write - NAME for cfg/task/NAME.yaml")])
    for number, entry in enumerate([*entries, *([] if _SELF in entries else [_SELF])]):
        if entry == _SELF:
            yield document, label
            continue
        place = where((DEFAULTS, number)).where
        target = _file(entry, file)
        if target is None:
            known = listing(sorted(path.stem for path in file.parent.glob("*.yaml") if path != file))
            message = (
                f"no file for '{entry}': rlcli reads only YAML files, no configurations that Python code registers"
            )
            raise ConfigError([Problem(place, DEFAULTS, message, f"files beside it: {known}")])
        if target.resolve() in active:
            message = f"'{entry}' lists itself; remove one of the entries"
            raise ConfigError([Problem(place, DEFAULTS, message)])
        yield from _parts(read(target), target, str(target), (*active, target.resolve()))


def _file(entry: Any, file: FilePath) -> FilePath | None:
    """Return the YAML file that an entry of a `defaults:` list names; None if there is none."""
    if not isinstance(entry, str) or not entry.strip("/"):
        return None
    folder = file.parent.parent if entry.startswith("/") else file.parent
    target = folder / f"{entry.strip('/')}.yaml"
    inside = target.resolve().is_relative_to(file.parent.parent.resolve())
    return target if inside and target.is_file() else None


def _merge(target: dict[str, Any], patch: dict[str, Any]) -> None:
    for key, value in patch.items():
        if isinstance(value, dict) and isinstance(target.get(key), dict):
            _merge(target[key], value)
        else:
            target[key] = value if not isinstance(value, dict) else {}
            if isinstance(value, dict):
                _merge(target[key], value)

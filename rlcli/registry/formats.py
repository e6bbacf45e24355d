"""Installed formats (entry-point group `rlcli.formats`), and known ones whose plugin is not installed."""

from __future__ import annotations

import functools
import json
import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rlcli.errors import DependencyError, TaskError
from rlcli.formats import FormatSpec
from rlcli.registry.entries import FORMATS, OWN, Entry, catalog, find_entry
from rlcli.registry.imports import load_entry
from rlcli.registry.source import TaskSource
from rlcli.task import API_VERSION

_log = logging.getLogger(__name__)

_KNOWN = Path(__file__).with_name("known_plugins.json")
_LARGEST = 1024 * 1024
"""Bytes of a file that is searched for the patterns of a known format."""
_MOST_FILES = 100


@dataclass(frozen=True, slots=True)
class Format:
    """An installed format."""

    entry: Entry
    spec: FormatSpec

    @property
    def name(self) -> str:
        """The name of its entry point."""
        return self.entry.name

    def load(self, reference: str) -> Any:
        """Import a part of the format by the reference of its spec.

        Raises:
            TaskError: if the plugin is broken.
        """
        return load_entry(replace(self.entry, value=reference), object)


@dataclass(frozen=True, slots=True)
class KnownFormat:
    """A format that exists in a plugin, as `known_plugins.json` describes it."""

    install: str
    """The line for pip."""
    summary: str
    key: str = ""
    modules: Sequence[str] = ()
    """Modules that only tasks of this format import."""
    files: Sequence[str] = ()
    """Patterns of file names."""
    all_of: Sequence[str] = ()
    """Regular expressions that are all found in such a file."""
    none_of: Sequence[str] = ()
    """Regular expressions of which none is."""

    def matches(self, file: Path) -> bool:
        """Whether a file looks like one of this format."""
        try:
            if not file.is_file() or file.stat().st_size > _LARGEST:
                return False
            text = file.read_text(encoding="utf-8", errors="replace")
        except OSError:
            return False
        found = [bool(re.search(pattern, text, re.MULTILINE)) for pattern in (*self.all_of, *self.none_of)]
        return all(found[: len(self.all_of)]) and not any(found[len(self.all_of) :])

    def missing(self, what: str = "") -> DependencyError:
        """Return the error that the plugin is not installed; `what` needs it."""
        message = f"the plugin that reads {self.summary} is not installed"
        return DependencyError(f"{what}: {message}" if what else message, hint=f"pip install {self.install}")


def load_format(name: str) -> Format:
    """Return an installed format by its name.

    Raises:
        TaskError: unknown, broken, or built for a newer rlcli.
    """
    return _load(find_entry(FORMATS, name, what="format"))


def installed_formats() -> Iterator[Format]:
    """Yield every installed format.

    Raises:
        TaskError: if one is broken, or built for a newer rlcli.
    """
    yield from map(_load, catalog(FORMATS)[0])


def usable_formats() -> Iterator[Format]:
    """Yield every installed format but broken ones, of which a warning tells."""
    for entry in catalog(FORMATS)[0]:
        try:
            yield _load(entry)
        except TaskError as error:
            _log.warning(error)


def find_in_formats(path: Path) -> TaskSource | None:
    """Return the task of a folder or file that an installed format recognises; broken formats are left out."""
    for form in usable_formats():
        found: TaskSource | None = form.load(form.spec.find)(path) if form.spec.find else None
        if found is not None:
            return found
    return None


def format_of_key(keys: Mapping[str, Any]) -> Format | None:
    """Return the format whose key is among these, if one with a value is."""
    given = {key for key, value in keys.items() if value}
    return next((form for form in installed_formats() if form.spec.key in given), None) if given else None


def format_of_module(module: str) -> Format | None:
    """Return the format whose package a module belongs to."""
    top = module.partition(".")[0]
    return next((_load(entry) for entry in catalog(FORMATS)[0] if _package(entry) == top), None)


def is_framework(module: str) -> bool:
    """Whether a module is rlcli's own or an installed format's, and not the user's, a library's or another plugin's."""
    return module.partition(".")[0] in _framework_packages()


@functools.cache
def _framework_packages() -> frozenset[str]:
    return frozenset((OWN, *(_package(entry) for entry in catalog(FORMATS, hidden=True)[0])))


def known_trainers() -> dict[str, str]:
    """Return the trainers that exist in plugins, each with the line for pip."""
    trainers: dict[str, str] = _known_plugins()["trainers"]
    return trainers


def known_formats() -> dict[str, KnownFormat]:
    """Return the formats that exist in plugins, by name."""
    return {name: KnownFormat(**values) for name, values in _known_plugins()["formats"].items()}


def missing_formats() -> dict[str, KnownFormat]:
    """Return the known formats that are not installed, by name."""
    installed = {entry.name for entry in catalog(FORMATS)[0]}
    return {name: form for name, form in known_formats().items() if name not in installed}


def format_keys() -> set[str]:
    """Return the keys of task files that belong to a format, installed or known."""
    known = {form.key for form in known_formats().values()}
    return (known | {form.spec.key for form in installed_formats()}) - {""}


def require_format(path: Path) -> None:
    """Check that a folder or file is of no known format whose plugin is not installed.

    Raises:
        DependencyError: if it is, with the line for pip.
    """
    for form in missing_formats().values():
        if path.is_dir():
            files = [file for pattern in form.files for file in sorted(path.glob(pattern))[:_MOST_FILES]]
        else:
            files = [path] if any(path.match(pattern) for pattern in form.files) else []
        if any(map(form.matches, files)):
            raise form.missing(f"'{path}'")


def require_module(error: BaseException) -> None:
    """Check that a failed import is not one of a known format's module whose plugin is not installed.

    Raises:
        DependencyError: if it is, with the line for pip.
    """
    name = error.name if isinstance(error, ModuleNotFoundError) else None
    for form in missing_formats().values() if name else ():
        if any(name == module or str(name).startswith(f"{module}.") for module in form.modules):
            raise form.missing(f"import of '{name}'") from error


def format_aliases() -> dict[str, str]:
    """Return the aliases of installed formats: module name -> the module it stands for."""
    return {alias: module for form in usable_formats() for alias, module in form.spec.aliases.items()}


def _load(entry: Entry) -> Format:
    spec: FormatSpec = load_entry(entry, FormatSpec)
    if spec.api > API_VERSION:
        raise TaskError(
            f"format '{entry.qualified}' ({entry.version}) needs plugin API {spec.api}; this rlcli has {API_VERSION}",
            hint="pip install --upgrade rlcli",
        )
    return Format(entry, spec)


def _package(entry: Entry) -> str:
    return entry.value.partition(":")[0].partition(".")[0]


@functools.cache
def _known_plugins() -> dict[str, Any]:
    plugins: dict[str, Any] = json.loads(_KNOWN.read_text(encoding="utf-8"))
    return plugins

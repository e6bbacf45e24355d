"""Entry points of installed distributions, read without importing any of them.

Distributions are read one by one, so that a broken one costs its own row and nothing else.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from rlcli.errors import TaskError, did_you_mean, listing
from rlcli.settings import setting, settings_file

TASKS = "rlcli.tasks"
TRAINERS = "rlcli.trainers"
FORMATS = "rlcli.formats"
GROUPS = (TASKS, TRAINERS, FORMATS)
"""The groups of entry points that plugins offer."""
OWN = "rlcli"
"""The distribution of the built-in tasks and trainers; a plugin cannot take their names."""

_entry_points: Any = vars(metadata.Distribution)["entry_points"].fget
"""As the standard library reads them, malformed or not, inside `malformed_metadata_ignored` too."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry point: what can be known of it without importing anything."""

    name: str
    value: str
    distribution: str
    version: str

    @property
    def qualified(self) -> str:
        """`distribution:name`, unique even where two distributions share a name."""
        return f"{self.distribution}:{self.name}"


@dataclass(frozen=True, slots=True)
class Broken:
    """A distribution whose metadata cannot be read."""

    distribution: str
    reason: str


def catalog(group: str = TASKS, *, hidden: bool = False) -> tuple[list[Entry], list[Broken]]:
    """Every entry of a group, sorted by name then distribution, and the distributions that could not be read.

    Those that RLCLI_PLUGINS or the user's settings leave out are only there if `hidden`.
    """
    entries: dict[tuple[str, str], Entry] = {}
    broken: dict[str, Broken] = {}
    wanted = None if hidden else _enabled_distributions()
    for distribution in metadata.distributions():
        folder = Path(str(getattr(distribution, "_path", "?"))).name
        try:
            text = distribution.read_text("entry_points.txt") or ""
            if group not in text:
                continue  # most distributions; their metadata is not read
            name, version = distribution.metadata["Name"], distribution.version
            if not name or not version:
                raise ValueError("no Name and Version in its METADATA")
            if wanted is not None and _normalized(name) not in wanted:
                continue
            for point in _entry_points(distribution):
                if point.group == group:
                    entries.setdefault((point.name, _normalized(name)), Entry(point.name, point.value, name, version))
        except Exception as error:
            broken.setdefault(folder, Broken(folder, f"malformed metadata ({type(error).__name__}: {error})"))
    return sorted(entries.values(), key=lambda e: (e.name, e.distribution)), list(broken.values())


def find_entry(group: str, name: str, *, what: str) -> Entry:
    """One entry of a group by its name or `distribution:name`."""
    entries, _ = catalog(group)
    matches = [e for e in entries if name in (e.name, e.qualified)]
    own = [e for e in matches if e.distribution == OWN]
    if len(matches) == 1 or own:
        return (own or matches)[0]
    if matches:
        owners = " and ".join(f"{e.distribution} {e.version}" for e in matches)
        choices = " or ".join(e.qualified for e in matches)
        raise TaskError(f"{what} '{name}' is offered by {owners}", hint=f"name one: {choices}")
    if any(name in (e.name, e.qualified) for e in catalog(group, hidden=True)[0]):
        value = os.environ.get("RLCLI_PLUGINS", "").strip()
        said = f"RLCLI_PLUGINS={value}" if value else plugins_chosen_by()
        remedy = "unset RLCLI_PLUGINS" if value else "name its distribution there, or remove that key"
        raise TaskError(f"{what} '{name}' is installed, but {said} leaves its plugin out", hint=remedy)
    names = list(dict.fromkeys(e.name for e in entries))
    installed = listing(sorted({f"{e.distribution} {e.version}" for e in entries}))
    near = did_you_mean(name, [*names, *(e.qualified for e in entries)] if ":" in name else names)
    where = f"installed: {listing(names)} (from {installed})"
    raise TaskError(f"no {what} '{name}'", hint=f"{near} {where}" if near else where)


def unreadable_distributions() -> list[Broken]:
    """Every installed distribution whose metadata is malformed, whether it has to do with rlcli or not."""
    found: dict[str, Broken] = {}
    for distribution in metadata.distributions():
        folder = Path(str(getattr(distribution, "_path", "?")))
        try:
            _entry_points(distribution)
            if not distribution.metadata["Name"] or not distribution.version:
                raise ValueError("no Name and Version in its METADATA")
        except Exception as error:
            reason = f"malformed metadata ({type(error).__name__}: {error}) in {folder}"
            found.setdefault(folder.name, Broken(folder.name, reason))
    return list(found.values())


def unknown_wanted() -> list[str]:
    """Names of plugins to use, of the variable or the user's settings, that have no tasks or trainers here."""
    wanted = _enabled_distributions()
    if not wanted:
        return []
    entries = [entry for group in GROUPS for entry in catalog(group, hidden=True)[0]]
    installed = {_normalized(entry.distribution) for entry in entries}
    return sorted(wanted - installed - {OWN})


def plugins_chosen_by() -> str:
    """What says which plugins to use: the variable, or the user's settings."""
    return "RLCLI_PLUGINS" if os.environ.get("RLCLI_PLUGINS", "").strip() else f"plugins in {settings_file()}"


@contextlib.contextmanager
def malformed_metadata_ignored() -> Iterator[None]:
    """Malformed metadata of an installed package stops nobody who reads the entry points of all packages.

    torch does when it is imported, TensorBoard too; without this one bad file of a stranger ends every command.
    `catalog` says which distribution it is.
    """
    before = vars(metadata.Distribution)["entry_points"]

    def readable(distribution: metadata.Distribution) -> Any:
        try:
            return _entry_points(distribution)
        except Exception:
            return metadata.EntryPoints()

    setattr(metadata.Distribution, "entry_points", property(readable))  # noqa: B010 - a property, to a type checker
    try:
        yield
    finally:
        setattr(metadata.Distribution, "entry_points", before)  # noqa: B010


def _enabled_distributions() -> set[str] | None:
    """Distributions that RLCLI_PLUGINS or the user's settings allow (`none` leaves the built-ins), or None for all."""
    value = os.environ.get("RLCLI_PLUGINS", "").strip()
    names = value.split(",") if value else setting("plugins")
    if names is None:
        return None
    return {"rlcli", *(_normalized(name.strip()) for name in names if name.strip().lower() != "none")}


def _normalized(distribution: str) -> str:
    return re.sub(r"[-_.]+", "-", distribution).lower()

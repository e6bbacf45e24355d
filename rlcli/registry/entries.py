"""Search for plugins: the entry points of installed distributions, read without importing a distribution.

Distributions are read one by one, so that a broken distribution does not hide the others.
"""

import contextlib
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from rlcli.errors import TaskError, did_you_mean, listing
from rlcli.safe_text import shorten
from rlcli.settings import setting, settings_file

TASKS = "rlcli.tasks"
"""Entry-point group of plugins with tasks."""
TRAINERS = "rlcli.trainers"
"""Entry-point group of plugins with trainers."""
FORMATS = "rlcli.formats"
"""Entry-point group of plugins with formats of other frameworks' task files."""
GROUPS = (TASKS, TRAINERS, FORMATS)
"""All entry-point groups of plugins."""
OWN = "rlcli"
"""The distribution of the built-in tasks and trainers. Its entries win over entries of plugins with the same name."""

MAX_ENTRIES = {TASKS: 1000, TRAINERS: 50, FORMATS: 50}
"""Largest number of entry points that a distribution may have in each group; every command loads all formats."""

_entry_points: Any = vars(metadata.Distribution)["entry_points"].fget
"""Function of the standard library that returns a distribution's entry points; raises for malformed metadata.

Inside of `malformed_metadata_ignored` the library has a replacement, so the original function is kept here.
"""


@dataclass(frozen=True, slots=True)
class Entry:
    """An entry point of an installed distribution, with which a plugin offers a task, a trainer or a format."""

    name: str
    """Name of the task, trainer or format."""
    value: str
    """Object that the entry point names, `module:attribute`."""
    distribution: str
    """Installed package (its name for pip) that has the entry point."""
    version: str
    """Version of the package."""

    @property
    def qualified(self) -> str:
        """The text `distribution:name`; two distributions may have entry points of the same name."""
        return f"{self.distribution}:{self.name}"

    @property
    def package(self) -> str:
        """The top-level package of the object that the entry point names."""
        return self.value.partition(":")[0].partition(".")[0]


@dataclass(frozen=True, slots=True)
class Broken:
    """A distribution whose metadata cannot be read."""

    distribution: str
    reason: str
    """Error of reading the metadata."""


def catalog(group: str = TASKS, *, hidden: bool = False) -> tuple[list[Entry], list[Broken]]:
    """Return every entry point of a group, and the distributions whose metadata could not be read.

    Args:
        group: the entry-point group, one of `GROUPS`.
        hidden: whether to return also the plugins that RLCLI_PLUGINS or the user's settings exclude.

    Returns:
        The entry points, sorted by name and distribution, and the unreadable distributions.
    """
    entries: dict[tuple[str, str], Entry] = {}
    broken: dict[str, Broken] = {}
    wanted = None if hidden else _enabled_distributions()
    for distribution in metadata.distributions():
        folder = Path(str(getattr(distribution, "_path", "?"))).name
        try:
            if group not in _entry_points_text(distribution):
                continue  # most distributions end here, before their metadata, which is slow to read
            name, version = _name_and_version(distribution)
            if wanted is not None and _normalized(name) not in wanted:
                continue
            for point in _plugin_points(distribution)[group]:
                entries.setdefault((point.name, _normalized(name)), Entry(point.name, point.value, name, version))
        except Exception as error:
            broken.setdefault(folder, Broken(folder, f"malformed metadata ({type(error).__name__}: {error})"))
    return sorted(entries.values(), key=lambda e: (e.name, e.distribution)), list(broken.values())


def _plugin_points(distribution: metadata.Distribution) -> dict[str, list[metadata.EntryPoint]]:
    """Return the entry points of a distribution in each group of plugins.

    Raises:
        ValueError: if the distribution has more than `MAX_ENTRIES`; other errors for malformed metadata.
    """
    found: dict[str, list[metadata.EntryPoint]] = {group: [] for group in GROUPS}
    for point in _entry_points(distribution):
        if point.group in found:
            found[point.group].append(point)
    for group, points in found.items():
        if len(points) > MAX_ENTRIES[group]:
            raise ValueError(f"{len(points)} entry points in {group}; at most {MAX_ENTRIES[group]} are allowed")
    return found


def _entry_points_text(distribution: metadata.Distribution) -> str:
    folder = getattr(distribution, "_path", None)
    if isinstance(folder, Path) and not os.path.exists(f"{folder}/entry_points.txt"):
        return ""
    return distribution.read_text("entry_points.txt") or ""


def _name_and_version(distribution: metadata.Distribution) -> tuple[str, str]:
    content = distribution.metadata  # each access parses the metadata again
    name, version = content["Name"], content["Version"]
    if not name or not version:
        raise ValueError("the METADATA of the package has no Name or no Version; reinstall the package")
    return name, version


def find_entry(group: str, name: str, *, what: str) -> Entry:
    """Return the entry point of a group by its name or by `distribution:name`.

    Args:
        group: the entry-point group.
        name: the name to look up.
        what: the kind of entry for messages: task, trainer or format.

    Raises:
        TaskError: if no entry or several entries have the name, or if its plugin is excluded.
    """
    entries, _ = catalog(group)
    matches = [e for e in entries if name in (e.name, e.qualified)]
    own = [e for e in matches if e.distribution == OWN]
    if len(matches) == 1 or own:
        return (own or matches)[0]
    if matches:
        owners = " and ".join(f"{e.distribution} {e.version}" for e in matches)
        choices = " or ".join(e.qualified for e in matches)
        raise TaskError(f"{what} '{name}' exists in several packages: {owners}", hint=f"write one of {choices}")
    excluded = next((e for e in catalog(group, hidden=True)[0] if name in (e.name, e.qualified)), None)
    if excluded is not None:
        plugin = excluded.distribution
        value = os.environ.get("RLCLI_PLUGINS", "").strip()
        excluded_by = f"RLCLI_PLUGINS={value}" if value else plugins_chosen_by()
        hint = "unset RLCLI_PLUGINS" if value else f"add {plugin} to this key, or remove the key"
        raise TaskError(f"{what} '{name}' is installed, but {excluded_by} excludes its plugin {plugin}", hint=hint)
    names = list(dict.fromkeys(e.name for e in entries))
    distributions = listing(sorted({f"{e.distribution} {e.version}" for e in entries}))
    similar = did_you_mean(name, [*names, *(e.qualified for e in entries)] if ":" in name else names)
    installed = f"installed: {listing(names)} (from {distributions})"
    hint = f"{similar} {installed}" if similar else f"{installed}; if its entry point is new, install the package again"
    raise TaskError(f"no {what} '{name}'", hint=hint)


def unreadable_distributions() -> list[Broken]:
    """Return every installed distribution whose metadata is malformed, whether or not it has plugins of rlcli."""
    found: dict[str, Broken] = {}
    for distribution in metadata.distributions():
        folder = Path(str(getattr(distribution, "_path", "?")))
        try:
            _plugin_points(distribution)
            _name_and_version(distribution)
        except Exception as error:
            reason = f"malformed metadata ({type(error).__name__}: {error}) in {folder}"
            found.setdefault(folder.name, Broken(folder.name, reason))
    return list(found.values())


def unknown_wanted() -> str:
    """Return the names in RLCLI_PLUGINS, or the setting `plugins`, that no installed plugin has.

    The result is one text for a message, such as `'my-plugin', 'other'`; it is empty if there are no such names.
    """
    wanted = _enabled_distributions()
    if not wanted:
        return ""
    entries = [entry for group in GROUPS for entry in catalog(group, hidden=True)[0]]
    installed = {_normalized(entry.distribution) for entry in entries}
    unknown = sorted(wanted - installed - {OWN})
    return listing((f"'{shorten(name, 40)}'" for name in unknown), limit=4) if unknown else ""


def plugins_chosen_by() -> str:
    """Return, as text for messages, what chooses the enabled plugins: RLCLI_PLUGINS, or a key of the settings file."""
    return "RLCLI_PLUGINS" if os.environ.get("RLCLI_PLUGINS", "").strip() else f"the key 'plugins' in {settings_file()}"


@contextlib.contextmanager
def malformed_metadata_ignored() -> Iterator[None]:
    """Make distributions with malformed metadata appear as distributions without entry points in the `with` block.

    torch and TensorBoard read the entry points of all packages when they are imported. Without this context, one
    malformed file of an unrelated package would end every command. `catalog` returns the distributions with malformed
    metadata.
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
    """Return the distributions that RLCLI_PLUGINS or the user's settings allow; None means all.

    The name `none` allows only the built-in tasks and trainers.
    """
    value = os.environ.get("RLCLI_PLUGINS", "").strip()
    names = value.split(",") if value else setting("plugins")
    if names is None:
        return None
    return {"rlcli", *(_normalized(name.strip()) for name in names if name.strip().lower() != "none")}


def _normalized(distribution: str) -> str:
    return re.sub(r"[-_.]+", "-", distribution).lower()

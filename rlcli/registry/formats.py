"""Formats: plugins (entry-point group `rlcli.formats`) that read the task files of other frameworks.

The module finds the installed formats. For known formats whose plugin is not installed, it returns an error with the
`pip install` command.
"""

import functools
import json
import logging
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rlcli.errors import DependencyError, TaskError, pip_install
from rlcli.formats import FormatSpec, Translation
from rlcli.registry.entries import FORMATS, OWN, Entry, catalog, find_entry
from rlcli.registry.plugin_imports import PluginError, call_entry, load_entry, load_spec, wrong_result
from rlcli.registry.task_location import TaskSource

_log = logging.getLogger(__name__)

_KNOWN = Path(__file__).with_name("known_plugins.json")
_LARGEST = 1024 * 1024
"""Files above this size [bytes] are not searched for the patterns of known formats."""
_MOST_FILES = 100
"""Largest number of files in a folder that are searched for each glob pattern."""


@dataclass(frozen=True, slots=True)
class Format:
    """An installed plugin that reads task files of another framework: its entry point and its `FormatSpec`."""

    entry: Entry
    spec: FormatSpec

    @property
    def name(self) -> str:
        """The name of the format's entry point."""
        return self.entry.name

    def load(self, reference: str) -> Any:
        """Import a function or class of the format; `reference` is a value of its `FormatSpec`, `module:name`.

        Raises:
            TaskError: if the plugin is broken.
        """
        return load_entry(replace(self.entry, value=reference), object)

    def call(self, part: str, *arguments: Any) -> Any:
        """Call a function of the format; return None if the format lacks the function. A generator is read to its end.

        Args:
            part: the attribute of the `FormatSpec` that names the function, such as `find`.
            arguments: the arguments of the function.

        Raises:
            PluginError: for any error of the plugin, and for a result of a wrong type.
        """
        reference = getattr(self.spec, part)
        if not reference:
            return None
        value = call_entry(replace(self.entry, value=reference), *arguments)
        is_valid, expected = _RESULTS[part]
        if not is_valid(value):
            raise wrong_result(self.entry, f"{part} = {reference}", value, expected)
        return value


def _is_mistake(item: Any) -> bool:
    """Return whether an item of the result of `FormatSpec.check` has the right form: (path, message, hint or None)."""
    if not isinstance(item, tuple | list) or len(item) != 3 or not isinstance(item[0], tuple | list):
        return False
    return all(isinstance(step, str | int) for step in item[0]) and isinstance(item[1], str) and _is_text(item[2])


def _is_text(value: Any) -> bool:
    return value is None or isinstance(value, str)


_RESULTS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "find": (lambda value: value is None or isinstance(value, TaskSource), "a TaskSource or None"),
    "read": (lambda value: value is None or isinstance(value, Translation), "a Translation or None"),
    "check": (lambda value: isinstance(value, list | tuple) and all(map(_is_mistake, value)), "(path, message, hint)s"),
    "hint": (_is_text, "a string or None"),
    "agents_beside": (
        lambda value: isinstance(value, list | tuple) and all(isinstance(file, Path) for file in value),
        "Paths",
    ),
    "agent_file": (lambda value: value is None or isinstance(value, dict), "a dict or None"),
}
"""Function of a `FormatSpec` -> the test of its result, and the allowed results in words, for the error message."""


@dataclass(frozen=True, slots=True)
class KnownFormat:
    """A format of other frameworks' task files that some plugin reads, installed or not, from `known_plugins.json`."""

    install: str
    """The arguments of `pip install`."""
    summary: str
    """The tasks that the format describes, for messages, as in `FormatSpec`."""
    key: str = ""
    """Top-level key of a task file that belongs to the format."""
    modules: Sequence[str] = ()
    """Modules that are imported only by tasks of this format."""
    files: Sequence[str] = ()
    """Glob patterns for the names of files that may be task files of this format."""
    all_of: Sequence[str] = ()
    """Regular expressions: a file of this format matches all of them."""
    none_of: Sequence[str] = ()
    """Regular expressions: a file of this format matches none of them."""

    def matches(self, file: Path) -> bool:
        """Return whether the text of a file matches `all_of` and not `none_of`; False for a file that is unreadable."""
        try:
            if not file.is_file() or file.stat().st_size > _LARGEST:
                return False
            text = file.read_text(encoding="utf-8", errors="replace")
        except OSError:
            return False

        def occurs(pattern: str) -> bool:
            return re.search(pattern, text, re.MULTILINE) is not None

        return all(map(occurs, self.all_of)) and not any(map(occurs, self.none_of))

    def missing(self, what: str = "") -> DependencyError:
        """Return the error for a missing plugin. `what` names the file or the import that needs it, for the message."""
        message = f"the plugin that reads {self.summary} is not installed"
        return DependencyError(f"{what}: {message}" if what else message, hint=pip_install(self.install))


def load_format(name: str) -> Format:
    """Return an installed format by its name.

    Raises:
        TaskError: if the format is unknown, broken, or needs a newer rlcli.
    """
    return _load(find_entry(FORMATS, name, what="format"))


def installed_formats() -> Iterator[Format]:
    """Yield every installed format.

    Raises:
        TaskError: if a format is broken, or needs a newer rlcli.
    """
    yield from map(_load, catalog(FORMATS)[0])


def usable_formats() -> Iterator[Format]:
    """Yield every installed format that works. For a broken format, log a warning instead."""
    for entry in catalog(FORMATS)[0]:
        try:
            yield _load(entry)
        except TaskError as error:
            _log.warning(error)


def find_in_formats(path: Path) -> TaskSource | None:
    """Return the task of a folder or file in an installed format; None if no working format recognises the path."""
    source: TaskSource | None = first_result("find", path)
    return source


def first_result(part: str, *arguments: Any) -> Any:
    """Call a function of each installed format until one returns another value than None; return this value.

    The arguments are those of `Format.call`. For a broken format, log a warning instead.
    """
    for form in usable_formats():
        try:
            if (found := form.call(part, *arguments)) is not None:
                return found
        except PluginError as error:
            _log.warning(error)
    return None


def format_of_key(keys: Mapping[str, Any]) -> Format | None:
    """Return the installed format whose `FormatSpec.key` has a non-empty value in `keys`; None if there is none.

    `keys` are the top-level keys of a task file.
    """
    used = {key for key, value in keys.items() if value}
    return next((form for form in installed_formats() if form.spec.key in used), None) if used else None


def format_of_module(module: str) -> Format | None:
    """Return the installed format whose plugin contains a module (a dotted name); None if there is no such format."""
    top = module.partition(".")[0]
    return next((_load(entry) for entry in catalog(FORMATS)[0] if entry.package == top), None)


def is_framework(module: str) -> bool:
    """Return whether a module belongs to rlcli or to an installed format, and not to the user or another package."""
    return module.partition(".")[0] in _framework_packages()


@functools.cache
def _framework_packages() -> frozenset[str]:
    return frozenset((OWN, *(entry.package for entry in catalog(FORMATS, hidden=True)[0])))


def known_trainers() -> dict[str, str]:
    """Return the arguments of `pip install` for the plugin of each trainer in `known_plugins.json`, by trainer name."""
    return dict(_known_plugins()["trainers"])


def known_formats() -> dict[str, KnownFormat]:
    """Return the formats in `known_plugins.json`, by name, whether or not their plugin is installed."""
    return {name: KnownFormat(**values) for name, values in _known_plugins()["formats"].items()}


def missing_formats() -> dict[str, KnownFormat]:
    """Return the known formats that are not installed, by name."""
    installed = {entry.name for entry in catalog(FORMATS)[0]}
    return {name: form for name, form in known_formats().items() if name not in installed}


def format_keys() -> set[str]:
    """Return the top-level keys of task files that belong to an installed or known format."""
    known = {form.key for form in known_formats().values()}
    return (known | {form.spec.key for form in installed_formats()}) - {""}


def require_format(path: Path) -> None:
    """Raise an error if a folder or file is in a known format whose plugin is not installed.

    Raises:
        DependencyError: with the `pip install` command of the plugin.
    """
    for form in missing_formats().values():
        if path.is_dir():
            files = [file for pattern in form.files for file in sorted(path.glob(pattern))[:_MOST_FILES]]
        else:
            files = [path] if any(path.match(pattern) for pattern in form.files) else []
        if any(map(form.matches, files)):
            raise form.missing(f"'{path}'")


def require_module(error: BaseException) -> None:
    """Raise an error if `error` is the failed import of a module that belongs to a known format without its plugin.

    Raises:
        DependencyError: with the `pip install` command of the format's plugin.
    """
    name = error.name if isinstance(error, ModuleNotFoundError) else None
    for form in missing_formats().values() if name else ():
        if any(name == module or str(name).startswith(f"{module}.") for module in form.modules):
            raise form.missing(f"import of '{name}'") from error


@functools.cache
def aliasing_formats() -> tuple[Format, ...]:
    """Return the installed formats that work and replace imports of task files (`FormatSpec.aliases`)."""
    return tuple(form for form in usable_formats() if form.spec.aliases)


def _load(entry: Entry) -> Format:
    return Format(entry, load_spec(entry, FormatSpec, "format"))


@functools.cache
def _known_plugins() -> dict[str, Any]:
    plugins: dict[str, Any] = json.loads(_KNOWN.read_text(encoding="utf-8"))
    return plugins

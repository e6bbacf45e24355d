"""Search for the Python code (`file:line`) that sets a value, for tasks and agents written for another framework.

Error messages name this place.
"""

import inspect
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from rlcli.config.layers import Origin
from rlcli.errors import ConfigError
from rlcli.registry import is_framework

_METHODS = ("__rlcli_task__", "__rlcli_agent__")
"""Names of methods by which objects of other frameworks' plugins (configurations, agents) are recognised."""


def place_of(value: object) -> str:
    """Return `file:line` of the class of a configuration or an agent of another framework; empty for other objects."""
    kind = value if isinstance(value, type) else type(value)
    if not any(hasattr(kind, name) for name in _METHODS) or is_framework(kind.__module__):
        return ""
    return class_place(kind)


def class_place(kind: type) -> str:
    """Return `file:line` of a class; empty if its source code is not known."""
    try:
        file, line = inspect.getsourcefile(kind), inspect.getsourcelines(kind)[1]
    except (OSError, TypeError):
        return ""
    return f"{short_path(Path(str(file)))}:{line}"


def code_origin(places: Mapping[tuple[str | int, ...], str], path: tuple[str | int, ...]) -> Origin | None:
    """Return the place of the code that sets the value at a path; None if the place is unknown.

    Args:
        places: path -> place of the code that sets the value there, as in `PythonTask.places`.
        path: keys of the value.
    """
    ends = (path[:count] for count in range(len(path), -1, -1))
    return next((Origin("task", places[end]) for end in ends if end in places), None)


def short_path(path: Path) -> Path:
    """Return the path relative to the current folder; a path outside of this folder is returned unchanged."""
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


def at_place(error: ConfigError, place: str) -> ConfigError:
    """Return a copy of the error in which `place` is the location of all problems that had none."""
    return ConfigError([replace(p, where=place) if p.where == "configuration" else p for p in error.problems])

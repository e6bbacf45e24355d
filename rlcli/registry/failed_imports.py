"""Placeholders for modules whose import failed in a package that registers several tasks.

With placeholders, the other tasks of the package can be used. Any use of a placeholder raises the import's error.
"""

import importlib
import logging
import sysconfig
import traceback
from pathlib import Path
from typing import Any

from rlcli.registry.formats import is_framework
from rlcli.registry.module_names import with_own_names

_log = logging.getLogger(__name__)
_failures: dict[str, Exception] = {}
"""Failed imports about which no warning was printed yet: name of the module -> error of the import."""
_places: dict[str, str] = {}
"""Name of a module whose import failed -> file and line of the import statement."""
_LIBRARIES = tuple(path for name, path in sysconfig.get_paths().items() if name.endswith(("lib", "stdlib")))
"""Folders of Python's standard library and of installed packages."""
_IMPORTLIB = str(Path(importlib.__file__).parent)


class FailedImport:
    """Replacement for a module whose import failed, and of its members. Its use raises the error of the import."""

    __all__: tuple[str, ...] = ()

    def __init__(self, name: str, error: Exception) -> None:
        self.__name__ = self.__module__ = name
        self._error = error

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return FailedImport(f"{self.__name__}.{name}", self._error)

    def __call__(self, *args: Any, **settings: Any) -> Any:
        """Raise the error of the import."""
        raise self._error

    __mro_entries__ = __call__


def failed_import(name: str, error: Exception, place: str) -> FailedImport:
    """Record that the import of a module failed, and return a replacement of the module.

    Args:
        name: name of the module.
        error: the error of the import.
        place: file and line of the import statement, for errors that no code of the module raised.
    """
    _failures[name] = error
    _places[name] = place
    return FailedImport(name, error)


def take_failures() -> list[str]:
    """Return a text for each import that failed since the last call: the module, the error, and its file and line."""
    texts = [f"{name} is left out: {error}" for name, error in _failures.items()]
    places = [error_location(error, _places[name]) for name, error in _failures.items()]
    found = [with_own_names(text) + place for text, place in zip(texts, places, strict=True)]
    _failures.clear()
    return found


def report_failures() -> None:
    """Log a warning for each failed import that was not reported yet."""
    for text in take_failures():
        _log.warning("%s", text)


def can_be_left_out(name: str, level: int, file: Path) -> bool:
    """Return whether a task file's failing import may be left out, because it may belong to another task.

    The file must be the `__init__.py` of a package, and this file or the `__init__.py` of the imported package must
    register tasks with Gymnasium.

    Args:
        name: name of the module in the import statement, without leading dots.
        level: number of leading dots.
        file: the importing file.
    """
    if file.name != "__init__.py":
        return False
    folder = file.parents[max(level - 1, 0)].joinpath(*name.split(".") if level else ())
    return any(b"register(" in start.read_bytes() for start in (file, folder / "__init__.py") if start.is_file())


def error_location(error: BaseException, importing: str = "") -> str:
    """Return ` (file:line)` of the code that raised an error, for messages.

    The line of the task's own code is preferred to lines of libraries and of rlcli; the text is empty without a line.

    Args:
        error: the error.
        importing: file and line of the import statement that failed, for an error that only rlcli's own code raised.
    """
    frames = [
        (frame.f_code.co_filename, line, is_framework(str(frame.f_globals.get("__name__", ""))))
        for frame, line in traceback.walk_tb(error.__traceback__)
        if not frame.f_code.co_filename.startswith(("<", _IMPORTLIB))
    ]
    if importing and all(frame[2] for frame in frames):
        return f" ({importing})"
    other = [frame for frame in frames if not frame[2]] or frames
    own = [frame for frame in other if not frame[0].startswith(_LIBRARIES)] or other
    return f" ({own[-1][0]}:{own[-1][1]})" if own else ""

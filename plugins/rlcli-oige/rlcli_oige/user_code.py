"""Location of the task's code that is running, for messages, and errors for attributes that rlcli's classes lack."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from rlcli.errors import TaskError
from rlcli.registry.framework_imports import TaskFileLoader


def user_file() -> tuple[Path, int] | None:
    """Return the file and line of the innermost code of a task on the call stack; None if no such code runs."""
    frame = sys._getframe(1)
    while frame is not None:
        if isinstance(frame.f_globals.get("__loader__"), TaskFileLoader):
            return Path(frame.f_code.co_filename), frame.f_lineno
        frame = frame.f_back  # type: ignore[assignment]
    return None


def user_location() -> str:
    """Return `FILE:LINE: ` of the innermost code of a task on the call stack; empty if no such code runs."""
    found = user_file()
    return "" if found is None else f"{found[0]}:{found[1]}: "


def error_location(error: BaseException) -> str:
    """Return `FILE:LINE` of the innermost code of a task in an error's traceback; empty if there is none."""
    found, entry = "", error.__traceback__
    while entry is not None:
        if isinstance(entry.tb_frame.f_globals.get("__loader__"), TaskFileLoader):
            found = f"{entry.tb_frame.f_code.co_filename}:{entry.tb_lineno}"
        entry = entry.tb_next
    return found


class MissingAttributeError(TaskError, AttributeError):
    """Error of a task that uses an attribute of a class of Isaac Sim which rlcli's replacement class lacks."""


class Counterpart:
    """Base class of the classes that replace a class of Isaac Sim.

    The use of an attribute that the replacement lacks raises an error with the user's line.
    """

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")
        own = next(kind.__name__ for kind in type(self).__mro__ if kind.__module__.startswith("rlcli_oige."))
        text = f"rlcli's {own} has no '{name}'"
        if own != type(self).__name__:
            text = f"{type(self).__name__} has no '{name}', and {text}"
        hint = "remove the line, or compute what it does with the methods that the class has"
        raise MissingAttributeError(f"{user_location()}{text}", hint=hint)

"""Place of the user's code that calls into this package, for messages."""

from __future__ import annotations

import sys
from pathlib import Path

from rlcli.registry.module_aliases import TaskFileLoader


def user_file() -> tuple[Path, int] | None:
    """Return the file and line of the innermost running code of a task; None outside of it."""
    frame = sys._getframe(1)
    while frame is not None:
        if isinstance(frame.f_globals.get("__loader__"), TaskFileLoader):
            return Path(frame.f_code.co_filename), frame.f_lineno
        frame = frame.f_back  # type: ignore[assignment]
    return None


def user_location() -> str:
    """Return `FILE:LINE: ` of the code of the task that is running; empty outside of it."""
    found = user_file()
    return "" if found is None else f"{found[0]}:{found[1]}: "

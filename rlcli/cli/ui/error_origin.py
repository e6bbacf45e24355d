"""Whose code raised an exception that nobody foresaw: rlcli's, which is a bug, or that of a task or plugin."""

from __future__ import annotations

import contextlib
import sysconfig
from pathlib import Path
from types import FrameType

import rlcli
from rlcli.errors import TaskError
from rlcli.registry import OWN, TASKS, TRAINERS, catalog, is_framework


def own_failure(error: BaseException) -> TaskError | None:
    """Return the error for an exception from a task's or plugin's own code; None for any other."""
    traceback, found, packages = error.__traceback__, None, _packages()
    while traceback is not None:
        if _is_own(traceback.tb_frame, packages):
            found = traceback
        traceback = traceback.tb_next
    if found is None:
        return None
    code = found.tb_frame.f_code
    place = f"{code.co_filename}:{found.tb_lineno}"
    message = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return TaskError(
        f"{place}: {code.co_name}: {message}", hint="the task's own code raised it; --debug shows the traceback"
    )


def _is_own(frame: FrameType, packages: dict[str, str]) -> bool:
    """Whether a frame is neither rlcli's nor a library's: it lies outside of both, or in an installed plugin."""
    file = frame.f_code.co_filename
    module = str(frame.f_globals.get("__name__", ""))
    offers = packages.get(module.partition(".")[0])
    if file.startswith("<") or is_framework(module) or offers == OWN:
        return False
    return offers is not None or not any(Path(file).is_relative_to(place) for place in _libraries())


def _packages() -> dict[str, str]:
    """The top-level packages of tasks and trainers that are installed, each with its distribution."""
    entries = []
    with contextlib.suppress(Exception):  # what cannot be read is not blamed
        entries = [entry for group in (TASKS, TRAINERS) for entry in catalog(group)[0]]
    return {entry.package: entry.distribution for entry in entries}


def _libraries() -> list[Path]:
    """Where Python, what is installed, and rlcli lie."""
    places = [Path(path) for name, path in sysconfig.get_paths().items() if name.endswith(("lib", "stdlib"))]
    return [*places, Path(rlcli.__file__).parent]

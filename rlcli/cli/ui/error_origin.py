"""Origin of an unexpected exception: the code of a task or plugin, a missing dependency, or a bug in rlcli."""

import contextlib
import re
import sysconfig
import traceback
from importlib import metadata
from pathlib import Path
from types import FrameType

import rlcli
from rlcli.errors import DependencyError, TaskError, error_with_type, pip_install
from rlcli.registry import OWN, TASKS, TRAINERS, catalog, is_framework


def error_of_task(error: BaseException) -> TaskError | None:
    """Return a TaskError for an exception from the code of a task or plugin; None for any other."""
    packages = _packages()
    found = [each for each in traceback.walk_tb(error.__traceback__) if _is_task_code(each[0], packages)]
    if not found:
        return None
    frame, line = found[-1]
    code = frame.f_code
    message = error_with_type(error)
    return TaskError(
        f"{code.co_filename}:{line}: {code.co_name}: {message}",
        hint="correct the task's code at this line; --debug shows the traceback",
    )


def missing_dependency(error: BaseException) -> DependencyError | None:
    """Return the error for a missing dependency of rlcli, with its pip command; None for other exceptions."""
    module = error.name if isinstance(error, ModuleNotFoundError) else None
    if module is None:
        return None
    distribution = _DISTRIBUTIONS.get(module, module.lower().replace("_", "-"))
    needed = [line for line in metadata.requires(OWN) or [] if re.split(r"[^\w.-]", line)[0].lower() == distribution]
    if not needed:
        return None
    extras = [match[1] for line in needed if (match := re.search(r"extra == .(\w+)", line))]
    extra = next((extra for extra in extras if extra not in ("all", "dev")), "all")
    hint = pip_install(f"{OWN}[{extra}]" if len(extras) == len(needed) else distribution)
    if distribution == "torch":
        hint += "; on Linux without a GPU, add --index-url https://download.pytorch.org/whl/cpu"
    return DependencyError(f"{distribution} is not installed", hint=hint)


_DISTRIBUTIONS = {"yaml": "pyyaml", "warp": "warp-lang", "mlflow": "mlflow-skinny"}
"""Module -> distribution, where the names differ."""


def _is_task_code(frame: FrameType, packages: dict[str, str]) -> bool:
    """Return whether a frame runs code of a task: a file outside of rlcli and libraries, or an installed plugin."""
    file = frame.f_code.co_filename
    module = str(frame.f_globals.get("__name__", ""))
    distribution = packages.get(module.partition(".")[0])
    if file.startswith("<") or is_framework(module) or distribution == OWN:
        return False
    return distribution is not None or not any(Path(file).is_relative_to(folder) for folder in _libraries())


def _packages() -> dict[str, str]:
    """Return the top-level packages of installed tasks and trainers, each with its distribution."""
    entries = []
    with contextlib.suppress(Exception):  # without readable metadata, installed plugins count as libraries
        entries = [entry for group in (TASKS, TRAINERS) for entry in catalog(group)[0]]
    return {entry.package: entry.distribution for entry in entries}


def _libraries() -> list[Path]:
    """Return the folders of Python, the installed packages and rlcli."""
    folders = [Path(path) for name, path in sysconfig.get_paths().items() if name.endswith(("lib", "stdlib"))]
    return [*folders, Path(rlcli.__file__).parent]

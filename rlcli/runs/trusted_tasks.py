"""Whose code may run: a run or a recording is data, and names code that is loaded only if the user has used it before.

Installed tasks are looked up among the installed ones. A task folder or a configuration in Python that a run names is
another matter: whoever wrote the run chose it. It is loaded if this user has named it on a command line of this machine
before; that is noted in a folder of the user's own, one file a task.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlcli.errors import MachineError
from rlcli.machine import read_plain
from rlcli.registry import TaskSource, find_task, python_place
from rlcli.runs.atomic_io import write_atomic

_LONGEST = 16 * 1024


def named_task(name: str) -> TaskSource:
    """A task that the user names to have its code run; from now on runs may name it too.

    Raises:
        TaskError: if there is no such task.
    """
    source = find_task(name)
    if source.distribution is None:
        _record_use(source.python or str(source.root))
    return source


def is_known(record: Mapping[str, Any]) -> bool:
    """Whether the user has named the folder or the Python configuration of a run's record before."""
    try:
        key = _key(record)
        return read_plain(_file(key), _LONGEST) == key.encode()
    except (OSError, RuntimeError, ValueError):  # none such; a loop of links; a name that cannot be one
        return False


def place(record: Mapping[str, Any]) -> str:
    """The code that a run's record names, as a command line would name it."""
    return str(record.get("python") or record["folder"])


def _key(record: Mapping[str, Any]) -> str:
    """The folder, or the file or package and the name in it, links resolved."""
    if not record.get("python"):
        return str(Path(str(record["folder"])).resolve())
    path, attribute = python_place(str(record["python"]))  # as it will be loaded
    return f"{path}:{attribute}" if attribute else str(path)


def _record_use(key: str) -> None:
    file = _file(key)
    with contextlib.suppress(OSError, MachineError):  # a note that cannot be kept means naming the task again
        if not file.exists():
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            write_atomic(file, key)
            file.chmod(0o600)


def _file(key: str) -> Path:
    """Where the use of a task is noted."""
    import platformdirs

    folder = os.environ.get("RLCLI_STATE_DIR") or platformdirs.user_state_dir("rlcli")
    return Path(folder) / "used-tasks" / hashlib.sha256(key.encode("utf-8", "surrogateescape")).hexdigest()

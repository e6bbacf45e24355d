"""Store which tasks the user trusts, so that rlcli does not execute code only because a downloaded run names it.

Installed tasks are always trusted. A run may also name a task folder or a configuration in Python. The author of the
run chose that code, so rlcli loads the code only after the user has given its path on a command line of this machine.
The user's state folder has one file for each such task.
"""

import contextlib
import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlcli.errors import MachineError
from rlcli.machine.plain_files import read_plain
from rlcli.registry import TaskSource, find_task, python_place
from rlcli.runs.atomic_io import write_atomic

_MAX_BYTES = 16 * 1024


def named_task(name: str) -> TaskSource:
    """Find a task that the user gives on a command line, and trust its code in runs from now on.

    Raises:
        TaskError: if there is no such task.
    """
    source = find_task(name)
    if source.distribution is None:
        _record_use(source.python or str(source.root))
    return source


def is_known(record: Mapping[str, Any]) -> bool:
    """Return whether the user has given this task on a command line before, so that its code is trusted.

    Args:
        record: the task's record (`TaskSource.record`), with its folder or its configuration in Python.
    """
    try:
        key = _key(record)
        return read_plain(_file(key), _MAX_BYTES) == key.encode()
    except (OSError, RuntimeError, ValueError):  # there is no such file, links form a loop, or the name is invalid
        return False


def named_code(record: Mapping[str, Any]) -> str:
    """Return the folder, or `FILE.py:NAME`, from a task's record, as the user writes it on a command line."""
    return str(record.get("python") or record["folder"])


def _key(record: Mapping[str, Any]) -> str:
    """Return the text that identifies the code of a task: the real path of its folder, or `FILE:ATTRIBUTE`.

    `record` is the task's record (`TaskSource.record`).
    """
    if not record.get("python"):
        return str(Path(str(record["folder"])).resolve())
    # the path is resolved in the same way as when the task is loaded
    path, attribute = python_place(str(record["python"]))
    return f"{path}:{attribute}" if attribute else str(path)


def _record_use(key: str) -> None:
    file = _file(key)
    with contextlib.suppress(OSError, MachineError):  # without the file, the user has to name the task again
        if not file.exists():
            file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            write_atomic(file, key)
            file.chmod(0o600)


def _file(key: str) -> Path:
    """Return the file in the user's state folder that exists if the user has named the task; for `key` see `_key`."""
    import platformdirs

    folder = os.environ.get("RLCLI_STATE_DIR") or platformdirs.user_state_dir("rlcli")
    return Path(folder) / "used-tasks" / hashlib.sha256(key.encode("utf-8", "surrogateescape")).hexdigest()

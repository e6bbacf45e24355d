"""Writing files so that a reader sees the old content or the new, whenever the writer dies."""

from __future__ import annotations

import contextlib
import json
import math
import os
from pathlib import Path
from typing import Any

from rlcli.errors import MachineError


def write_atomic(file: Path, content: bytes | str) -> None:
    """Write to a temporary neighbour, fsync, rename.

    Raises:
        MachineError: if the disk refuses; the old file is untouched.
    """
    data = content.encode() if isinstance(content, str) else content
    temporary = file.with_name(f".{file.name}.tmp-{os.getpid()}")
    try:
        temporary.unlink(missing_ok=True)  # a link in its place would be followed
        write_synced(temporary, data)
        os.replace(temporary, file)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise disk_error(file, error) from error
        raise


def write_synced(file: Path, data: bytes) -> None:
    """Write a file and wait until it is on the disk."""
    with file.open("wb") as handle:
        handle.write(data)
        handle.flush()
        os.fsync(handle.fileno())


def sync_folder(folder: Path) -> None:
    """Wait until a folder's entries are on the disk, where the system can."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def to_json(value: object) -> str:
    """JSON with a final newline; numbers that are not finite are refused."""
    return json.dumps(value, indent=2, allow_nan=False) + "\n"


def finite_json(value: Any) -> Any:
    """Return a copy in which numbers that are not finite are text, since JSON has none."""
    if isinstance(value, dict):
        return {key: finite_json(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [finite_json(inner) for inner in value]
    return repr(value) if isinstance(value, float) and not math.isfinite(value) else value


def disk_error(path: Path, error: OSError) -> MachineError:
    """What the machine said, for the user."""
    return MachineError(f"cannot write {path}: {error.strerror or error}", hint=_HINTS.get(error.errno or 0))


_HINTS = {
    28: "free some space, then go on with --resume",
    13: "choose another folder with --runs-dir",
    30: "choose another folder with --runs-dir",
    122: "the disk quota is used up",
}

"""Write files atomically: after a crash a reader finds either the whole old content or the whole new content.

The files of runs, exports and reports are written by these functions. Errors of the disk become errors with a hint.
"""

import contextlib
import errno
import glob
import json
import math
import os
import re
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rlcli.errors import MachineError, UsageError
from rlcli.runs.run_lock import require_locks


def write_atomic(file: Path, content: bytes | str) -> Path:
    """Write a file so that a crash leaves either the old or the new content; return the file.

    The content goes to a temporary file in the same folder, which is synced to the disk and then renamed.

    Raises:
        MachineError: if the disk reports an error, or the file is in a run whose lock this process has lost; the old
            file is unchanged.
        UsageError: if the path is a folder, a pipe, a socket or a device.
    """
    require_regular(file)
    data = content.encode() if isinstance(content, str) else content
    temporary = file.with_name(f".{file.name}.tmp-{os.getpid()}")
    try:
        with disk_errors(file):
            temporary.unlink(missing_ok=True)  # open() would follow a link with this name
            write_synced(temporary, data)
            require_lock(file)
            os.replace(temporary, file)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
    return file


def require_regular(file: Path) -> None:
    """Check that a path can be written as a file: nothing is there yet, or a regular file.

    Raises:
        UsageError: for a folder, a pipe, a socket or a device.
        MachineError: if the disk reports an error.
    """
    with disk_errors(file):
        try:
            mode = os.stat(file).st_mode
        except (FileNotFoundError, NotADirectoryError):  # writing reports a missing folder
            return
    if not stat.S_ISREG(mode):
        kinds = ((stat.S_ISDIR, "folder"), (stat.S_ISFIFO, "pipe"), (stat.S_ISSOCK, "socket"))
        kind = next((kind for is_kind, kind in kinds if is_kind(mode)), "device")
        raise UsageError(f"cannot write {file}: it is a {kind}", hint="give the name of a new or a regular file")


def require_writable(file: Path) -> None:
    """Check, before any work, that a file can be written: no folder or device has its name, and its folder is writable.

    Access rights do not show this for every folder, so an empty temporary file is created and removed. If the folder
    does not exist yet, the nearest existing folder above is tested.

    Raises:
        UsageError: for a folder, a pipe, a socket or a device.
        MachineError: if the disk reports an error.
    """
    require_regular(file)
    target = file.absolute()
    while not target.parent.exists() and target.parent != target:
        target = target.parent
    temporary = target.with_name(f".{target.name}.tmp-{os.getpid()}")
    with disk_errors(file):
        temporary.unlink(missing_ok=True)
        os.close(os.open(temporary, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        temporary.unlink()


def write_synced(file: Path, data: bytes) -> None:
    """Write a file and wait until its content is on the disk."""
    with file.open("wb") as handle:
        handle.write(data)
        handle.flush()
        os.fsync(handle.fileno())


def remove_leftovers(folder: Path, name: str) -> None:
    """Remove the temporary files and folders `.NAME.tmp-PID...` that killed processes have left in a folder.

    `name` is NAME, the file or folder to which the processes would have renamed the temporary ones.
    """
    for leftover in folder.glob(f".{glob.escape(name)}.tmp-*") if os.name == "posix" else ():
        process = re.match(r"\d+", leftover.name.rpartition(".tmp-")[2])
        with contextlib.suppress(OSError):
            if process is not None and not _is_running(int(process[0])):
                shutil.rmtree(leftover) if leftover.is_dir() and not leftover.is_symlink() else leftover.unlink()


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # a process of another user
        return True
    return True


def sync_folder(folder: Path) -> None:
    """Wait until the entries of a folder are on the disk; does nothing on Windows, which cannot sync folders."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def to_json(value: object) -> str:
    """Return a value as indented JSON text with a final newline.

    Raises:
        ValueError: if a number is not finite.
    """
    return json.dumps(value, indent=2, allow_nan=False) + "\n"


def finite_json(value: Any) -> Any:
    """Return a copy of JSON data in which NaN and infinity are replaced by the texts `nan`, `inf` and `-inf`."""
    if isinstance(value, dict):
        return {key: finite_json(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [finite_json(inner) for inner in value]
    return repr(value) if isinstance(value, float) and not math.isfinite(value) else value


def disk_error(path: Path, error: OSError) -> MachineError:
    """Return the MachineError for an OSError while writing a path, with a hint that fits the cause (errno)."""
    gone = [str(folder) for folder in path.parents if error.errno == errno.ENOENT and not folder.exists()]
    missing = f" (there is no folder {gone[-1]})" if gone else ""
    hint = _HINTS.get(error.errno or 0) if gone or error.errno != errno.ENOENT else "choose another folder"
    return MachineError(f"cannot write {path}: {error.strerror or error}{missing}", hint=hint)


def require_lock(path: Path) -> None:
    """Check that this process still holds the lock of the run that contains a path; other paths need no lock.

    Raises:
        MachineError: if the lock file was deleted or replaced, or the run was moved away.
    """
    try:
        require_locks(path)
    except OSError as error:
        raise disk_error(path, error) from error


@contextlib.contextmanager
def disk_errors(path: Path, *, remove: bool = False) -> Iterator[None]:
    """Turn an OSError inside the `with` block into a MachineError that names the path.

    Args:
        path: the file or folder that the block writes.
        remove: after an error, delete the folder at this path.

    Raises:
        MachineError: if the disk reports an error, or the path is in a run whose lock this process has lost.
    """
    require_lock(path)
    try:
        yield
    except (OSError, MachineError) as error:
        if remove:
            shutil.rmtree(path, ignore_errors=True)
        if isinstance(error, OSError):
            require_lock(path)  # another process may have removed what is missing
            raise disk_error(path, error) from error
        raise


_HINTS = {
    2: "create the folder; if the folder was moved or deleted meanwhile, put it back",
    27: "files are limited to the size that `ulimit -f` shows: raise this limit, or write smaller files",
    28: "free some space",
    36: "a name in a path has at most 255 bytes: shorten it",
    13: "choose another path (for runs: --runs-dir FOLDER)",
    30: "the disk is read-only: make it writable, copy the run, or choose another path (for runs: --runs-dir FOLDER)",
    122: "the disk quota is used up: free some space",
}
"""Error number of the operating system (errno), such as ENOSPC for a full disk -> hint for the user."""

"""Lock of a run's folder: only the process that holds the lock may write to the run.

Each write checks the lock first, because the folder may have been deleted or moved.
"""

import os
import stat
from pathlib import Path
from weakref import WeakValueDictionary

from filelock import FileLock, Timeout

from rlcli.errors import MachineError

LOCK = ".lock"
_TIMEOUT_S = 0.3
"""Time to wait for the lock [s]; `is_locked` of another process holds it for a shorter time."""


class RunLock:
    """Lock of a folder, by a lock on its file `.lock`. The operating system releases it when the process ends.

    Args:
        folder: the folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self._file = folder, folder / LOCK
        self._lock = FileLock(self._file, timeout=_TIMEOUT_S)
        self._identity = (0, 0)

    def acquire(self) -> None:
        """Take the lock; wait at most `_TIMEOUT_S` for another process.

        Raises:
            MachineError: if another process holds the lock.
            OSError: if the lock file cannot be opened.
        """
        try:
            self._lock.acquire()
        except Timeout:
            message = f"another process writes to {self.folder}; wait until that process has ended"
            raise MachineError(message) from None
        self._identity = _identity(self._file)
        _held[self.folder] = self

    def release(self) -> None:
        """Release the lock."""
        if _held.get(self.folder) is self:
            del _held[self.folder]
        self._lock.release()

    def require(self) -> None:
        """Check that the lock file is still the file that this process has locked.

        The lock is lost if the file was deleted, or if the folder was moved away and another folder is in its place: a
        second process could then lock the folder, too.

        Raises:
            MachineError: if the lock is lost.
            OSError: if the folder does not exist any more.
        """
        try:
            is_ours = _identity(self._file) == self._identity
        except FileNotFoundError:
            if not self.folder.exists():
                raise
            is_ours = False
        if not is_ours:
            cause = f"{self._file.name} was deleted or the folder was replaced"
            message = f"this process has lost the lock of {self.folder}: {cause}"
            hint = "wait until no other process writes to the folder, then start again"
            raise MachineError(f"{message}, and nothing more is written", hint=hint)


_held: WeakValueDictionary[Path, RunLock] = WeakValueDictionary()
"""Locks that this process holds, by folder."""


def require_locks(path: Path) -> None:
    """Check that this process still holds its locks of the folders that contain a path.

    Raises:
        MachineError: if this process has lost a lock.
        OSError: if such a folder does not exist any more.
    """
    for folder, lock in list(_held.items()):
        if path.is_relative_to(folder):
            lock.require()


def is_locked(folder: Path) -> bool:
    """Return whether a process has locked the run; no file is created or changed."""
    try:
        handle = os.open(folder / LOCK, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    except OSError:
        return False
    try:
        return stat.S_ISREG(os.fstat(handle).st_mode) and not _can_share(handle)
    finally:
        os.close(handle)


def _identity(file: Path) -> tuple[int, int]:
    """Return the device and the inode of a file; while a file is open, no other file has the same pair."""
    found = os.stat(file)
    return found.st_dev, found.st_ino


def _can_share(handle: int) -> bool:
    """Return whether a shared lock of the open lock file can be taken, which means that no process holds the lock.

    The shared lock ends when the handle is closed.
    """
    try:
        import fcntl
    except ImportError:  # Windows
        import msvcrt

        try:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
            msvcrt.locking(handle, msvcrt.LK_UNLCK, 1)  # type: ignore[attr-defined]
        except OSError:
            return False
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # the file system does not support locks
        return True
    return True

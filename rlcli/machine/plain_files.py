"""Function that reads a regular file, and never blocks on a device or an empty pipe."""

import errno
import os
import select
import stat
from pathlib import Path

_PIPE_S = 10.0
"""Time to wait for the first byte of a pipe [s]."""


def read_plain(file: Path, most: int, *, pipe: bool = False) -> bytes:
    """Return the content of a regular file. A device at this path is refused without blocking.

    Args:
        file: the file.
        most: largest size of the file [bytes].
        pipe: whether the file may be a pipe, as a shell creates it for `--config <(...)`.

    Raises:
        OSError: if the file is missing, is not a regular file, is larger than `most` bytes, or if a pipe stays empty
            for 10 s.
    """
    descriptor = os.open(file, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with open(descriptor, "rb") as opened:
        mode = os.fstat(descriptor).st_mode
        if not (stat.S_ISREG(mode) or (pipe and stat.S_ISFIFO(mode))):
            raise OSError(errno.EINVAL, "it is not a regular file", str(file))
        if stat.S_ISFIFO(mode):
            if not select.select([descriptor], [], [], _PIPE_S)[0]:
                raise OSError(errno.EAGAIN, f"nothing was written to the pipe in {_PIPE_S:g} s", str(file))
            os.set_blocking(descriptor, True)
        data: bytes | None = opened.read(most + 1)
        if data is None:  # files such as /proc/kmsg
            raise OSError(errno.EAGAIN, "the system gives no content of this file now", str(file))
    if len(data) > most:
        raise OSError(errno.EFBIG, f"the file is larger than {most} bytes, the most that rlcli reads", str(file))
    return data

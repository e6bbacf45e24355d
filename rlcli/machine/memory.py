"""Memory that this process may use, and errors about too little memory."""

import contextlib
import logging
import os
import re
from pathlib import Path

from rlcli.errors import DeviceError, MachineError, RlcliError, error_text, one_line
from rlcli.machine.control_groups import GROUPS, OWN_GROUP, control_groups

_log = logging.getLogger(__name__)

_NO_LIMIT = 1 << 60
"""A memory limit of at least this number [bytes] means "no limit": version 1 of control groups writes about 2**63."""
_NO_MEMORY = re.compile(
    r"(not|n't) allocate memory|not enough memory|bad_alloc|failed to map segment|n't start new thread|unable to mmap"
    r"|out of memory",
    re.IGNORECASE,
)
"""Texts of the errors of MuJoCo, torch, the dynamic linker and Python that mean too little memory; their classes
differ."""
_UNDER_A_LIMIT = re.compile(r"failed to load the shared library|framebuffer is not complete", re.IGNORECASE)
"""Texts of errors of Warp and OpenGL that can have several causes. If the process has a memory limit, these errors mean
too little memory."""
_IN_LITTLE_MEMORY = re.compile("caught an unknown exception", re.IGNORECASE)
"""Text of an error of MuJoCo, for a lack of memory and for some mistakes in an MJCF. It means too little memory if the
memory limit of the process leaves less than `_ENOUGH`."""
_ENOUGH = 1 << 30
"""Memory [bytes] that suffices to read any MJCF that is not refused for its size."""


def memory_limit(groups: Path = GROUPS, own: Path = OWN_GROUP) -> int | None:
    """Return the memory limit of this process or its control group [bytes]; None if there is no limit."""
    limits = [address_space() or _NO_LIMIT]
    for folder in control_groups("memory", groups, own):
        for name in ("memory.max", "memory.limit_in_bytes"):
            try:
                limits.append(int((folder / name).read_text(encoding="utf-8")))
            except (OSError, ValueError):  # the file is missing, or holds the word `max`
                continue
    return min((limit for limit in limits if limit < _NO_LIMIT), default=None)


def available_memory(report: Path = Path("/proc/meminfo")) -> int:
    """Return the memory of the machine that is still available [bytes]; `memory_limit` returns limits of the process.

    The value is `MemAvailable` of Linux; else half of the machine's memory; else 8 GiB.
    """
    try:
        lines = report.read_text(encoding="utf-8").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, StopIteration, IndexError):
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    except (AttributeError, OSError, ValueError):
        return 8 * 2**30


def address_space() -> int | None:
    """Return the limit that `ulimit -v` sets for this process [bytes]; None if there is no limit."""
    with contextlib.suppress(ImportError):  # Windows has no `resource`
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        return limit if 0 < limit < _NO_LIMIT else None
    return None


def require_address_space(least: int = 1 << 30) -> None:
    """Check that a limit such as `ulimit -v` leaves enough memory to load large libraries.

    Otherwise the libraries would end the process without a message.

    Args:
        least: the limit that the libraries need [bytes]. The default is for torch and MuJoCo.

    Raises:
        MachineError: if the limit is lower.
    """
    if (limit := address_space()) is not None and limit < least:
        message = f"the process is limited to {limit >> 20} MiB of memory; {least >> 20} are needed"
        raise MachineError(message, hint="raise the limit, for example with `ulimit -v unlimited`")


def require_memory(size: int, what: str) -> None:
    """Check that enough memory is free. Without this check, the system may kill the process later.

    Log a warning if a large part of the free memory is needed, because `size` is only a lower bound.

    Args:
        size: the memory [bytes].
        what: what needs the memory, a plural noun for the message, such as `1024 environments`.

    Raises:
        DeviceError: if less memory is free.
    """
    free = min(available_memory(), memory_limit() or _NO_LIMIT)
    if size > free:
        message = f"{what} need at least {size / 2**30:.1f} GiB, {free / 2**30:.1f} GiB are free on this machine"
        raise DeviceError(message, hint="use fewer environments: --num-envs")
    if size > free / 4:
        _log.warning(f"{what} need at least {size / 2**30:.1f} GiB of the {free / 2**30:.1f} GiB that are free")


def resident_memory(report: Path = Path("/proc/self/statm")) -> int | None:
    """Return the memory that this process occupies now [bytes]; None if the system does not report it."""
    try:
        return int(report.read_text(encoding="utf-8").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError, AttributeError):
        return None


def _used_address_space(report: Path = Path("/proc/self/statm")) -> int:
    try:
        return int(report.read_text(encoding="utf-8").split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError, AttributeError):
        return _NO_LIMIT


def memory_error(error: BaseException | None) -> MachineError | None:
    """Return the error to show if an exception, or one of its causes, means too little memory; else None."""
    limit = address_space()
    limited = f" (the process is limited to {limit >> 20} MiB)" if limit else ""
    while error is not None:
        text = error_text(error)
        if isinstance(error, MemoryError) or (
            not isinstance(error, RlcliError)
            and (
                _NO_MEMORY.search(text)
                or (limit and _UNDER_A_LIMIT.search(text))
                or (limit and _IN_LITTLE_MEMORY.search(text) and limit - _used_address_space() < _ENOUGH)
            )
        ):
            sizes = "scene.num_envs, or the sizes of networks and histories"
            hint = f"close other programs, raise the limit of the process (`ulimit -v`), or lower {sizes}"
            return MachineError(f"too little memory{limited}: {one_line(error, 200)}", hint=hint)
        error = error.__cause__ or error.__context__
    return None

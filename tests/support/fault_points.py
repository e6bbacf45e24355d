"""Faults at named moments of a process, injected into its system calls; no code of rlcli is replaced.

A point is a call and what it is called with; the fault happens the n-th time that it is reached, and, where it is an
error of the machine, every time from then on.
"""

import atexit
import errno
import os
import pkgutil
import re
import resource
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

KILLED_AT = {
    # point -> (call, pattern of the path, before or after the call, or in the middle of a write)
    "temporary folder made": ("mkdir", r"checkpoints/\.tmp-[^/]*$", "after"),
    "in the middle of a file": ("write", r"checkpoints/\.tmp-.*/trainer\.safetensors$", "middle"),
    "before a file's fsync": ("fsync", r"checkpoints/\.tmp-.*/[^/]+\.\w+$", "before"),
    "after a file's fsync": ("fsync", r"checkpoints/\.tmp-.*/[^/]+\.\w+$", "after"),
    "before the rename": ("rename", r"checkpoints/\.tmp-[^/]* -> .*/\d{12}$", "before"),
    "after the rename": ("rename", r"checkpoints/\.tmp-[^/]* -> .*/\d{12}$", "after"),
    "before the folder's fsync": ("fsync", r"/checkpoints$", "before"),
    "before latest": ("replace", r"checkpoints/latest$", "before"),
    "in a removal": ("unlink", r"^(policy|trainer|state|env|rng|manifest)\.\w+$", "after"),
    "after a removal's rename": ("rename", r"checkpoints/\d{12} -> .*/\.tmp-", "after"),
    "in the middle of a metrics line": ("write", r"/metrics\.jsonl$", "middle"),
    "in the middle of replay rows": ("write", r"checkpoints/logs/replay/\..*tmp-", "middle"),
    "before replay rows have their name": ("replace", r"checkpoints/logs/replay/", "before"),
    "before run.json": ("replace", r"/run\.json$", "before"),
    "in the middle of run.json": ("write", r"/\.run\.json\.tmp-", "middle"),
    "in the middle of a kept episode": ("write", r"/autopsy/\.\d+-env.*tmp-", "middle"),
    "before a kept episode has its name": ("replace", r"/autopsy/\d+-env", "before"),
    # while a run is resumed
    "before the metrics are cut": ("replace", r"/metrics\.jsonl$", "before"),
    "after the metrics are cut": ("replace", r"/metrics\.jsonl$", "after"),
    "in the middle of the cut": ("write", r"/\.metrics\.jsonl\.tmp-", "middle"),
    "in the middle of TensorBoard's cut": ("write", r"/tb/\.events.*tmp-", "middle"),
    "after TensorBoard's cut": ("replace", r"/tb/events", "after"),
}
"""Moments at which a process is killed."""


_SLOW = 12


def plant(
    kind: str, call: str, pattern: str, when: str = "before", nth: int = 1, code: str = "EIO", seconds: float = 0.0
) -> None:
    """Inject a fault into this process.

    Args:
        kind: kill, error (raise `code` from now on), short (write half, then `code`), full (the file is /dev/full),
            limit (files to `code` bytes), clock (moved by `code` seconds), sleep, or slow (for the next dozen times:
            add a dot to a file `slow`, and sleep).
        call: mkdir, open, write, fsync, rename, replace, unlink, or `module:name` in Python.
        pattern: what the path must match; of two, "source -> target".
        when: before or after the call, or in the middle of what is written.
        nth: which time.
        code: name of the error.
        seconds: to sleep.
    """
    expression, lock, count = re.compile(pattern), threading.Lock(), [0]

    def due(path: str) -> bool:
        if not expression.search(path):
            return False
        with lock:
            count[0] += 1
            again = kind in ("error", "short") or (kind == "slow" and count[0] < nth + _SLOW)
            return count[0] == nth or (count[0] > nth and again)

    def strike() -> None:
        if kind == "kill":
            os.kill(os.getpid(), signal.SIGKILL)
        elif kind == "sleep":
            time.sleep(seconds)
        elif kind == "limit":
            soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
            resource.setrlimit(resource.RLIMIT_FSIZE, (int(code), hard))
            # coverage writes its file after the program has ended
            atexit.register(resource.setrlimit, resource.RLIMIT_FSIZE, (soft, hard))
        elif kind == "clock":
            real, shift = time.time, float(code)
            time.time = lambda: real() + shift
        elif kind == "slow":
            with open("slow", "a") as marks:
                marks.write(".")
            time.sleep(seconds)
        else:
            number = getattr(errno, code)
            raise OSError(number, os.strerror(number))

    if kind == "full":
        _onto_a_full_device(due)
    elif call == "write":
        _in_writes(due, strike, halfway=kind == "short" or when == "middle")
    elif call == "open":
        _in_opens(due, strike)
    elif call in _OS_CALLS:
        _in_call(os, call, _OS_CALLS[call], due, strike, when)
    elif ":" in call:
        module, _, place = call.partition(":")
        owner, _, name = place.rpartition(".")
        _in_call(pkgutil.resolve_name(f"{module}:{owner}"), name, lambda *_, **__: call, due, strike, when)
    else:
        raise ValueError(call)


def _pair(source: Any, target: Any, **_: Any) -> str:
    return f"{source} -> {target}"


_OS_CALLS: dict[str, Callable[..., str]] = {
    "mkdir": lambda path, *_, **__: str(path),
    "fsync": lambda handle: os.readlink(f"/proc/self/fd/{handle}"),
    "rename": _pair,
    "replace": lambda source, target, **_: str(target),
    "unlink": lambda path, *_, **__: str(path),
}


def _in_call(
    owner: Any, name: str, path: Callable[..., str], due: Callable[[str], bool], strike: Callable[[], None], when: str
) -> None:
    real = getattr(owner, name)

    def call(*arguments: Any, **named: Any) -> Any:
        now = due(path(*arguments, **named))
        if now and when == "before":
            strike()
        result = real(*arguments, **named)
        if now and when == "after":
            strike()
        return result

    setattr(owner, name, call)


def _onto_a_full_device(due: Callable[[str], bool]) -> None:
    real = Path.open

    def call(self: Path, mode: str = "r", *arguments: Any, **named: Any) -> Any:
        target = Path("/dev/full") if mode == "a" and due(str(self)) else self
        return real(target, mode, *arguments, **named)

    Path.open = call  # type: ignore[method-assign,assignment]


def _in_opens(due: Callable[[str], bool], strike: Callable[[], None]) -> None:
    real = Path.open

    def call(self: Path, mode: str = "r", *arguments: Any, **named: Any) -> Any:
        if ("w" in mode or "a" in mode) and due(str(self)):
            strike()
        return real(self, mode, *arguments, **named)

    Path.open = call  # type: ignore[method-assign,assignment]


def _in_writes(due: Callable[[str], bool], strike: Callable[[], None], *, halfway: bool) -> None:
    real = Path.open

    class Handle:
        def __init__(self, path: Path, handle: Any) -> None:
            self._path, self._handle = path, handle

        def write(self, data: Any) -> int:
            if due(str(self._path)):
                if halfway:
                    self._handle.write(data[: len(data) // 2])
                    self._handle.flush()
                strike()
            return self._handle.write(data)

        def __getattr__(self, name: str) -> Any:
            return getattr(self._handle, name)

        def __enter__(self) -> Any:
            return self

        def __exit__(self, *_: object) -> None:
            self._handle.close()

    def call(self: Path, mode: str = "r", *arguments: Any, **named: Any) -> Any:
        handle = real(self, mode, *arguments, **named)
        return Handle(self, handle) if "w" in mode or "a" in mode else handle

    Path.open = call  # type: ignore[method-assign,assignment]

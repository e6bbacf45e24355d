"""Signals that end a command: the first one ends the command with a message, the second one at once."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from types import FrameType
from typing import TYPE_CHECKING

from rlcli.errors import INTERRUPTED, STOPPED, Stopped

STOP_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGUSR1", "SIGHUP") if hasattr(signal, name)
)
"""Signals from Ctrl-C, from a scheduler such as Slurm (SIGTERM, SIGUSR1), and from a terminal that closes. Windows has
only some of them."""
_PAUSE_S = 0.01
"""Time after which a signal is sent again: the destructor that has swallowed its KeyboardInterrupt has ended [s]."""
_received: list[int] = []

if TYPE_CHECKING:
    from sys import UnraisableHookArgs


def raise_on_signals() -> None:
    """Raise KeyboardInterrupt at the first of `STOP_SIGNALS`; signals that the process ignores (nohup) stay ignored.

    Python drops an exception of a destructor (`__del__`) or of a weak reference's callback. If KeyboardInterrupt is
    dropped in this way, it is raised again later.
    """
    for number in STOP_SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _receive)
    sys.unraisablehook = _on_dropped_exception


def end_on_signals() -> None:
    """Let signals end the process at once, without a message of Python, because its command has ended.

    With `python -m rlcli`, CPython replaces the exit code by SIGINT if KeyboardInterrupt has passed through code that a
    C library runs (`PyRun_String`), although the exception was handled. The next code that is run so clears its flag.
    """
    for number in STOP_SIGNALS:
        if signal.getsignal(number) is _receive:
            signal.signal(number, signal.SIG_DFL)
    if _received:
        import ctypes

        ctypes.pythonapi.PyRun_SimpleString(b"")


def stopped_by_signal() -> Stopped | None:
    """Return the error for the signal that this process has received; None: no signal."""
    if not _received:
        return None
    if _received[0] == signal.SIGINT:
        return Stopped("interrupted", exit_code=INTERRUPTED)
    name = signal.Signals(_received[0]).name
    return Stopped(f"stopped by the signal {name}", exit_code=STOPPED, hint="run the command again")


def _receive(number: int, _: FrameType | None) -> None:
    if _received:
        signal.signal(number, signal.SIG_DFL)
        os.kill(os.getpid(), number)
        return
    _received.append(number)
    raise KeyboardInterrupt


def _on_dropped_exception(found: UnraisableHookArgs) -> None:
    if not issubclass(found.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(found)
    elif _received:
        timer = threading.Timer(_PAUSE_S, _send_again)
        timer.daemon = True
        with contextlib.suppress(RuntimeError):  # the interpreter is ending
            timer.start()


def _send_again() -> None:
    os.kill(os.getpid(), _received.pop())

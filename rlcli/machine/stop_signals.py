"""Signals that end a command: the first one ends the command with a message, the second one at once."""

from __future__ import annotations

import os
import signal
from types import FrameType

from rlcli.errors import INTERRUPTED, STOPPED, Stopped

STOP_SIGNALS = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGUSR1", "SIGHUP") if hasattr(signal, name)
)
"""Signals from Ctrl-C, from a scheduler such as Slurm (SIGTERM, SIGUSR1), and from a terminal that closes. Windows has
only some of them."""
_received: list[int] = []


def raise_on_signals() -> None:
    """Raise KeyboardInterrupt at the first of `STOP_SIGNALS`; signals that the process ignores (nohup) stay ignored."""
    for number in STOP_SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _receive)


def end_on_signals() -> None:
    """Let signals end the process at once, without a message of Python, because its command has ended."""
    for number in STOP_SIGNALS:
        if signal.getsignal(number) is _receive:
            signal.signal(number, signal.SIG_DFL)


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

"""Signals (Ctrl-C, SIGTERM) that stop a training.

After the first signal, the training writes a checkpoint and stops. A second signal stops the training at once.

Commands that train use the context manager `StopRequest`.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

from rlcli.envs.observers import StepObserver
from rlcli.errors import INTERRUPTED, STOPPED, Stopped
from rlcli.machine.stop_signals import STOP_SIGNALS


class Interrupted(KeyboardInterrupt):
    """Exception that ends an iteration after a signal; a resumed run repeats this iteration."""


@dataclass(slots=True)
class StopRequest(StepObserver):
    """Context manager that stores the first signal, and raises `Interrupted` in iterations that may be interrupted.

    A second signal always raises KeyboardInterrupt. Signals that the process ignores from its start (nohup) stay
    ignored.
    """

    signal: int | None = None
    """Number (such as SIGINT) of the first signal; None: no signal yet."""
    can_interrupt: bool = False
    """Whether an iteration may be interrupted in the middle."""
    ends_process: bool = False
    """Whether the process ends after the context. Later signals are then ignored, to keep the exit code."""
    _interruptible: bool = False
    _previous: dict[int, Any] = field(default_factory=dict)

    @property
    def exit_code(self) -> int:
        """Exit code of the process: 130 after Ctrl-C, 75 after another signal."""
        return INTERRUPTED if self.signal in (None, signal.SIGINT) else STOPPED

    @contextlib.contextmanager
    def interruptible(self, interruptible: bool = True) -> Iterator[None]:
        """Raise `Interrupted` at the first signal, anywhere in the `with` block, if `interruptible` is true."""
        self._interruptible = interruptible
        try:
            self.check()
            yield
        finally:
            self._interruptible = False

    @contextlib.contextmanager
    def before_training(self, interruptible: bool = True) -> Iterator[None]:
        """Stop at the first signal inside the `with` block, which prepares a training, or at the end of the block.

        Args:
            interruptible: whether a signal stops the block in the middle; false: at its end.

        Raises:
            Stopped: on a signal.
        """
        try:
            with self.interruptible(interruptible):
                yield
            if self.signal is not None:
                raise Interrupted
        except (KeyboardInterrupt, Exception) as error:
            # an extension module that is being imported may replace the interrupt by an error of its own
            if self.signal is None and not isinstance(error, KeyboardInterrupt):
                raise
            raise Stopped("stopped before training began", exit_code=self.exit_code) from None

    def before_step(self) -> None:
        """Raise `Interrupted` again before the next step, in case a task's code has caught the exception."""
        self.check()

    def check(self) -> None:
        """Check for a signal.

        Raises:
            Interrupted: if a signal has arrived and the work may be interrupted here.
        """
        if self._interruptible and self.signal is not None:
            raise Interrupted

    def __enter__(self) -> StopRequest:
        # Python allows signal handlers only in the main thread
        if threading.current_thread() is threading.main_thread():
            for number in STOP_SIGNALS:
                if signal.getsignal(number) is not signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        ends_now = self.ends_process and self.signal is not None
        for number, handler in self._previous.items():
            signal.signal(number, signal.SIG_IGN if ends_now else handler)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            raise KeyboardInterrupt
        self.signal = number
        self.check()

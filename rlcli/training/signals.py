"""Signals that stop a training: the first one at the next step or boundary, the second one at once."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

from rlcli.envs.observers import StepObserver
from rlcli.errors import Stopped

_SIGNALS = ("SIGINT", "SIGTERM", "SIGUSR1", "SIGHUP")
"""Ctrl-C; what schedulers send as a warning and before they kill; a terminal that closes."""


class Interrupted(KeyboardInterrupt):
    """Raised in the middle of an iteration, whose work is lost."""


@dataclass(slots=True)
class StopRequest(StepObserver):
    """Context that stores the first signal in `signal` and raises where that loses nothing; a second one always raises.

    Signals that the process ignored from its start (nohup) stay ignored.
    """

    signal: int | None = None
    can_interrupt: bool = False
    """Whether an iteration may be left in the middle."""
    ends_process: bool = False
    """Whether the process ends after the context: signals after the first are ignored then, to keep the exit code."""
    _interruptible: bool = False
    _previous: dict[int, Any] = field(default_factory=dict)

    @property
    def exit_code(self) -> int:
        """130 after Ctrl-C, 75 after a scheduler's signal."""
        return 130 if self.signal in (None, signal.SIGINT) else 75

    @contextlib.contextmanager
    def interruptible(self, interruptible: bool = True) -> Iterator[None]:
        """Let the first signal raise `Interrupted` wherever Python is, while there is a boundary to return to."""
        self._interruptible = interruptible
        try:
            self.check()
            yield
        finally:
            self._interruptible = False

    @contextlib.contextmanager
    def before_training(self, interruptible: bool = True) -> Iterator[None]:
        """Let the first signal end what comes before training.

        Raises:
            Stopped: on a signal.
        """
        try:
            with self.interruptible(interruptible):
                yield
            if self.signal is not None:
                raise Interrupted
        except (KeyboardInterrupt, Exception) as error:
            # an extension that is being imported may replace the interrupt by an error of its own
            if self.signal is None and not isinstance(error, KeyboardInterrupt):
                raise
            raise Stopped("stopped before training began", exit_code=self.exit_code) from None

    def before_step(self) -> None:
        """Check before every environment step: other code may have caught the exception of the signal."""
        self.check()

    def check(self) -> None:
        """Raise if a signal has arrived.

        Raises:
            Interrupted: if a signal has arrived and stopping here loses nothing.
        """
        if self._interruptible and self.signal is not None:
            raise Interrupted

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():  # elsewhere Python allows no handler
            for number in (getattr(signal, name) for name in _SIGNALS if hasattr(signal, name)):
                if signal.getsignal(number) is not signal.SIG_IGN:
                    self._previous[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        over = self.ends_process and self.signal is not None
        for number, handler in self._previous.items():
            signal.signal(number, signal.SIG_IGN if over else handler)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            raise KeyboardInterrupt
        self.signal = number
        self.check()

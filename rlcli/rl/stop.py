"""Being asked to stop: the first signal ends training at the next step or boundary, the second at once."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

from rlcli.errors import Stopped

_SIGNALS = ("SIGINT", "SIGTERM", "SIGUSR1", "SIGHUP")
"""Ctrl-C; what schedulers send before they kill, and as a warning; a terminal that closes."""


class Interrupted(KeyboardInterrupt):
    """Raised in the middle of an iteration: what it did is thrown away."""


@dataclass(slots=True)
class StopRequest:
    """Notes the first signal in `signal`, and raises where that loses nothing; a second one always does.

    Used as a context.

    A signal that whoever started the process has it ignore (nohup) stays ignored.
    """

    signal: int | None = None
    can_interrupt: bool = False
    """Whether an iteration may be left in the middle."""
    ends_process: bool = False
    """Whether nothing comes after it: once it was asked to stop, a further signal would only spoil the exit code."""
    _prompt: bool = False
    _previous: dict[int, Any] = field(default_factory=dict)

    @property
    def exit_code(self) -> int:
        """130 after Ctrl-C, 75 after what a scheduler sends."""
        return 130 if self.signal in (None, signal.SIGINT) else 75

    @contextlib.contextmanager
    def prompt(self, prompt: bool = True) -> Iterator[None]:
        """Whether the first signal raises: only while there is a boundary to go back to.

        It raises wherever Python is, be it in a rollout or in a long update.
        """
        self._prompt = prompt
        try:
            self.check()
            yield
        finally:
            self._prompt = False

    @contextlib.contextmanager
    def before_training(self, prompt: bool = True) -> Iterator[None]:
        """Whether the first signal ends what comes before training.

        Raises:
            Stopped: if it has.
        """
        try:
            with self.prompt(prompt):
                yield
            if self.signal is not None:
                raise Interrupted
        except (KeyboardInterrupt, Exception) as error:
            # an extension that is being imported makes an error of its own of the interrupt
            if self.signal is None and not isinstance(error, KeyboardInterrupt):
                raise
            raise Stopped("stopped before training began", exit_code=self.exit_code) from None

    def check(self) -> None:
        """Called before every environment step, where somebody between may have caught what the signal raised.

        Raises:
            Interrupted: if a signal has come, and to stop here loses nothing.
        """
        if self._prompt and self.signal is not None:
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

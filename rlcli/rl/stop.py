"""Being asked to stop: the first signal ends training at the next step or boundary, the second at once."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from types import FrameType
from typing import Any

_SIGNALS = ("SIGINT", "SIGTERM", "SIGUSR1", "SIGHUP")
"""Ctrl-C; what schedulers send before they kill, and as a warning; a terminal that closes."""


class Interrupted(KeyboardInterrupt):
    """Raised in the middle of an iteration: what it did is thrown away."""


@dataclass(slots=True)
class StopRequest:
    """Notes the first signal in `signal`; a second one raises KeyboardInterrupt. Used as a context.

    A signal that whoever started the process has it ignore (nohup) stays ignored.
    """

    signal: int | None = None
    can_interrupt: bool = False
    """Whether somebody calls `check` before every step."""
    _prompt: bool = False
    _previous: dict[int, Any] = field(default_factory=dict)

    @property
    def exit_code(self) -> int:
        """130 after Ctrl-C, 75 after what a scheduler sends."""
        return 130 if self.signal in (None, signal.SIGINT) else 75

    @contextlib.contextmanager
    def prompt(self, prompt: bool = True) -> Iterator[None]:
        """Whether `check` raises: only while there is a boundary to go back to."""
        self._prompt = prompt
        try:
            yield
        finally:
            self._prompt = False

    def check(self) -> None:
        """Called before every environment step.

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
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            raise KeyboardInterrupt
        self.signal = number

"""Being asked to stop: the first SIGINT or SIGTERM waits for the next boundary, the second does not wait."""

from __future__ import annotations

import signal
import threading
from dataclasses import dataclass, field
from types import FrameType
from typing import Any


@dataclass(slots=True)
class StopRequest:
    """Notes the first signal in `signal`; a second one raises KeyboardInterrupt. Used as a context."""

    signal: int | None = None
    _previous: dict[int, Any] = field(default_factory=dict)

    @property
    def exit_code(self) -> int:
        """130 after Ctrl-C, 75 after a scheduler's SIGTERM."""
        return 75 if self.signal == signal.SIGTERM else 130

    def __enter__(self) -> StopRequest:
        if threading.current_thread() is threading.main_thread():  # elsewhere Python allows no handler
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            raise KeyboardInterrupt
        self.signal = number

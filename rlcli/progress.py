"""Progress of long work: a library function reports it with `track`, and the command line shows it."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TypeVar

T = TypeVar("T")


@dataclass(slots=True)
class Work:
    """State of one piece of work, such as the episodes of an evaluation: its name, its size and how much is done."""

    what: str
    """Name of the work, or of its parts, such as `episodes`."""
    total: int | None = None
    """Number of parts; None: unknown."""
    done: int = 0
    """Number of parts that are done."""
    share: float = 0.0
    """Second estimate of the done share, from 0 to 1; the larger one counts. It is set for parts that run at the same
    time, such as episodes in parallel environments: `done` stays 0 until the first of them ends."""
    has_own_view: bool = False
    """Whether this work shows its own progress, so that nothing else may be drawn."""
    begin: float = field(default_factory=time.monotonic)
    """Start of the work, by `time.monotonic` [s]."""
    changed: float = field(default_factory=time.monotonic)
    """Time of the last progress, by `time.monotonic` [s]; at first the start."""
    thread: int = field(default_factory=threading.get_ident)
    """Thread that does the work. Works of several threads run at the same time; none is a part of another."""

    def advance(self, count: int = 1) -> None:
        """Add `count` to the number of parts that are done."""
        self.update(self.done + count, self.share)

    def update(self, done: int, share: float) -> None:
        """Set the number of parts that are done, and the second estimate of the done share."""
        self.done, self.share, self.changed = done, share, time.monotonic()

    def fraction(self) -> float:
        """Return the share of the work that is done, from 0 to 1; 0 if it is unknown."""
        return min(1.0, max(self.share, self.done / self.total if self.total else 0.0))


_running: list[Work] = []
view: Callable[[list[Work]], AbstractContextManager[object]] | None = None
"""Function from a list of nested work, the outermost first, to a context that shows it; None: nothing is shown."""


@contextlib.contextmanager
def track(what: str, total: int | None = None, *, has_own_view: bool = False) -> Iterator[Work]:
    """Report a piece of work, which is done in the `with` block, so that its progress can be shown.

    Work inside of other work is shown together with it.

    Args:
        what: what is counted, such as `episodes`.
        total: the number of parts; None: unknown.
        has_own_view: whether the work shows its own progress, so that nothing else may be drawn.
    """
    work = Work(what, total, has_own_view=has_own_view)
    shown = view(_running) if view is not None and not _running else contextlib.nullcontext()
    _running.append(work)
    try:
        with shown:
            yield work
    finally:
        _running.remove(work)


def tracked(items: Iterable[T], what: str, total: int) -> Iterator[T]:
    """Yield the items one by one, and report the progress: an item is done when the next one is requested.

    `what` is what is counted, `total` the number of items.
    """
    with track(what, total) as work:
        for item in items:
            yield item
            work.advance()

"""Progress of long operations: functions report their progress with `track`, and the command line shows it."""

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TypeVar

T = TypeVar("T")


@dataclass(slots=True)
class Work:
    """Progress of an operation, such as an evaluation: its name, the number of its parts, and how many are done."""

    what: str
    """Name of the operation, or of the things that are counted, such as `episodes`."""
    total: int | None = None
    """Number of parts; None: unknown."""
    done: int = 0
    """Number of parts that are done."""
    share: float = 0.0
    """The operation's own estimate of the share of the work that is done, from 0 to 1. Operations set `share` if their
    parts run at the same time, such as episodes in parallel environments, where `done` is 0 until the first one ends.
    `fraction` returns the larger value of `share` and `done` / `total`."""
    has_own_view: bool = False
    """Whether the operation shows its own progress, so that no second progress bar may be drawn."""
    phases: Sequence[str] = ()
    """Names of the parts, if the parts are done one after the other and differ in kind; `what` is then not shown."""
    begin: float = field(default_factory=time.monotonic)
    """Start of the work, by `time.monotonic` [s]."""
    changed: float = field(default_factory=time.monotonic)
    """Time of the last progress, by `time.monotonic` [s]; before any progress, the start."""
    thread: int = field(default_factory=threading.get_ident)
    """Id of the operation's thread. Operations of different threads are not nested in each other."""

    def advance(self, count: int = 1) -> None:
        """Add `count` to the number of parts that are done."""
        self.update(self.done + count, self.share)

    def update(self, done: int, share: float) -> None:
        """Set `done`, the number of parts that are done, and `share`, the operation's own estimate."""
        self.done, self.share, self.changed = done, share, time.monotonic()

    def text(self) -> str:
        """Return text such as `episodes 3/10`; for named parts, number and name of the present part."""
        if self.phases:
            number = min(self.done, len(self.phases) - 1)
            return f"{number + 1} of {len(self.phases)}: {self.phases[number]}"
        return f"{self.what} {self.done:,}/{self.total:,}" if self.total else self.what

    def fraction(self) -> float:
        """Return the share of the work that is done, from 0 to 1; 0 if unknown."""
        return min(1.0, max(self.share, self.done / self.total if self.total else 0.0))


_running: list[Work] = []
"""Running operations, the outermost first."""
view: Callable[[list[Work]], AbstractContextManager[object]] | None = None
"""Function from the list of running operations, the outermost first, to a context manager that shows their progress.

The command line sets this variable; None: nothing is shown.
"""


@contextlib.contextmanager
def track(
    what: str, total: int | None = None, *, has_own_view: bool = False, phases: Sequence[str] = ()
) -> Iterator[Work]:
    """Report the progress of the operation in a `with` block.

    The `with` statement returns a `Work`; the code of the block calls its method `advance` or `update`. Progress of an
    operation inside the block is shown below that of the block.

    Args:
        what: what is counted, such as `episodes`.
        total: the number of parts; None: unknown.
        has_own_view: whether the operation shows its own progress, so that no second progress bar may be drawn.
        phases: names of the parts, if the parts are done one after the other and differ in kind; `total` is then
            ignored.
    """
    work = Work(what, len(phases) or total, has_own_view=has_own_view, phases=phases)
    shown = view(_running) if view is not None and not _running else contextlib.nullcontext()
    _running.append(work)
    try:
        with shown:
            yield work
    finally:
        _running.remove(work)


def tracked(items: Iterable[T], what: str, total: int) -> Iterator[T]:
    """Yield items and report their number as progress; an item counts as done when the next item is requested.

    Args:
        items: the items.
        what: name of the items, such as `episodes`.
        total: number of items.
    """
    with track(what, total) as work:
        for item in items:
            yield item
            work.advance()

"""Progress of long work: a library function reports it with `track`, and the command line shows it."""

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import TypeVar

T = TypeVar("T")


@dataclass(slots=True)
class Work:
    """Some work in progress."""

    what: str
    total: int | None = None
    """Number of its parts; None: unknown."""
    done: int = 0
    share: float = 0.0
    """Share of the work that is done, if it is more than `done` of `total` parts: parts may end together."""
    has_own_view: bool = False
    """Whether this work shows its own progress."""
    begin: float = field(default_factory=time.monotonic)

    def advance(self, count: int = 1) -> None:
        """Count parts that are done."""
        self.done += count

    def fraction(self) -> float:
        """Return the share of the work that is done; 0 if it is unknown."""
        return min(1.0, max(self.share, self.done / self.total if self.total else 0.0))


_running: list[Work] = []
view: Callable[[list[Work]], AbstractContextManager[object]] | None = None
"""Returns the context that shows a list of nested work, the outermost first; None: nothing is shown."""


@contextlib.contextmanager
def track(what: str, total: int | None = None, *, has_own_view: bool = False) -> Iterator[Work]:
    """Report work while the context is open; work inside other work is shown together with it.

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
    """Yield the items, and report each as done when the next one is needed."""
    with track(what, total) as work:
        for item in items:
            yield item
            work.advance()

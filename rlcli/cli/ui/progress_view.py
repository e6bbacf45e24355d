"""Views that show the progress of a command or a training: a live block on a terminal, else a line now and then."""

import contextlib
import sys
import threading
import time
from collections.abc import Sequence
from typing import Any, Self

from rlcli.cli.ui.console import console, plain
from rlcli.cli.ui.tables import fill
from rlcli.cli.ui.terminal import is_terminal, rich_console
from rlcli.progress import Work, track
from rlcli.training.progress import PARTS, Progress

LINE_EVERY_S = 5.0
_WORK_LINE_EVERY_S = 10.0
_WORK_AFTER_S = 1.4
"""Time after which the progress of work is shown on a terminal [s]; shorter work shows no progress."""
_REDRAW_EVERY_S = 0.25
_MIN_SHARE, _MIN_ELAPSED_S = 0.2, 30.0
"""The time left is shown when this share of the work is done or this time [s] has passed.

Earlier estimates are too long, because the first parts include imports and compilation.
"""
_MAX_ROWS = 100
"""Rows of one table; an untrusted run may have any number of metrics."""
_MAX_S = 1e10
"""Largest duration that is printed [s]; a longer one is printed as this limit."""
_LINE_METRICS = (
    ("Train/mean_reward", "return", ".3f"),
    ("Train/mean_episode_length", "length", ".0f"),
    ("Train/success_rate", "success", ".1%"),
)


class LiveView:
    """Context manager that redraws a block of lines on stderr; without a terminal it draws nothing."""

    def __init__(self, **options: Any) -> None:
        self._options = options
        self._live: Any = None
        self._own = track("", has_own_view=True)

    def __enter__(self) -> Self:
        self._own.__enter__()
        console.clear_line()
        if is_terminal(sys.stderr) and not console.quiet:
            from rlcli.cli.ui.resizable_live import ResizableLive

            self._live = ResizableLive(console=rich_console(sys.stderr), **self._options)
            self._live.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._own.__exit__(*error)
        if self._live is not None:
            with contextlib.suppress(OSError):  # the terminal may be closed
                self._live.__exit__(*error)

    def update(self, lines: Sequence[str], *, refresh: bool = False) -> None:
        """Replace the lines of the live block; with `refresh` draw the block at once. Needs a terminal."""
        from rich.text import Text

        self._live.update(Text("\n".join(lines)), refresh=refresh)


class WorkView:
    """View of a command's progress (`rlcli.progress`): one line, redrawn on a terminal, else a new line every 10 s."""

    def __init__(self, running: list[Work]) -> None:
        self._running = running
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._show, daemon=True)

    def __enter__(self) -> Self:
        if not console.quiet and not console.muted:
            self._thread.start()
        return self

    def __exit__(self, *error: Any) -> None:
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _show(self) -> None:
        if not is_terminal(sys.stderr):
            while not self._ended.wait(_WORK_LINE_EVERY_S):
                self._print_line()
        elif not self._ended.wait(_WORK_AFTER_S):
            with contextlib.suppress(OSError, ValueError):  # the terminal may be closed
                self._redraw(sys.stderr)

    def _print_line(self) -> None:
        if not any(work.has_own_view for work in list(self._running)):
            console.info(work_line(self._running))

    def _redraw(self, stream: Any) -> None:
        """Redraw the line of progress in place, until the work has ended."""
        while not self._ended.is_set():
            if not any(work.has_own_view for work in list(self._running)):
                console.clear_line()
                stream.write(plain(work_line(self._running))[: rich_console(stream).width - 1])
                stream.flush()
                console.has_line = True
            self._ended.wait(_REDRAW_EVERY_S)
        console.clear_line()


def work_line(running: Sequence[Work]) -> str:
    """Return one line about the running work: names with counts, percentage, time left.

    Args:
        running: unfinished parts of the command, the outermost first; parts of several threads are mixed.
    """
    works = list(running)
    counts = [work.text() for work in works]
    counted = [work for work in works if work.total]
    threads: dict[int, list[Work]] = {}
    for work in counted:
        threads.setdefault(work.thread, []).append(work)
    share = sum(_share(nested) * (nested[0].total or 1) for nested in threads.values())
    share /= max(1, sum(nested[0].total or 1 for nested in threads.values()))
    now, changed = time.monotonic(), max((work.changed for work in counted), default=0.0)
    elapsed = max(0.0, changed - counted[0].begin) if counted else 0.0
    title = "" if not works or works[0].total else f"{counts.pop(0)}: "
    if share > 0.0:
        counts.append(f"{share:.0%}")
    if share >= _MIN_SHARE or (share > 0.0 and elapsed >= _MIN_ELAPSED_S):
        # the time since the end of the last part is subtracted from its estimate; a negative result is not shown
        left = elapsed * (1.0 - share) / share - (now - changed)
        if left >= 0.0:
            return f"{title}{', '.join(counts)}, {duration_text(left)} left"
    since = f"{duration_text(now - works[0].begin)} so far" if works else ""
    return title + ", ".join([*counts, since])


def _share(nested: Sequence[Work]) -> float:
    """Return the fraction of the outermost work that is done, 0 to 1.

    `nested` begins with the outermost work; each further work is one of the parts that the work before it counts.
    """
    share = 0.0
    for work in reversed(nested):
        share = max(work.fraction(), (work.done + share) / (work.total or 1))
    if len(nested) > 1:
        nested[0].share = share  # it does not fall while one part has ended and the next has not begun
    return share


class TrainingView(LiveView):
    """View of a training: a live table on a terminal, else a line every few seconds."""

    def __init__(self, title: str) -> None:
        super().__init__(refresh_per_second=8, transient=False)
        self._title = title
        self._last_line = 0.0
        self._last: Progress | None = None

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        if self._live is None and self._last is not None:
            console.info(_line(self._last))

    def show(self, progress: Progress) -> None:
        """Show the progress after one iteration."""
        self._last = progress
        if self._live is not None:
            self._live.update(self._table(progress))
        elif time.monotonic() - self._last_line >= LINE_EVERY_S:
            self._last_line = time.monotonic()
            console.info(_line(progress))
            self._last = None

    def _table(self, progress: Progress) -> Any:
        from rich.columns import Columns
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        m = progress.metrics
        total = max(sum(progress.seconds.values()), 1e-9)
        split = [f"{part} {progress.seconds.get(part, 0.0) / total:4.0%}" for part in PARTS]
        speed = [f"{progress.env_steps:,} steps", f"{progress.steps_per_s:,.0f} steps/s"]
        state = [self._title, _iteration(progress), *speed, _left(progress)]
        width = self._live.console.width
        head = Text.assemble(("\n".join(fill(state, width)), "bold"), "\n", ("\n".join(fill(split, width)), "dim"))
        tables = []
        for heading, prefix in (
            ("training", "Train/"),
            ("evaluation", "Eval/"),
            ("reward terms", "Episode_Reward/"),
            ("terminations", "Episode_Termination/"),
            ("learner", ("Loss/", "Policy/")),
        ):
            rows = [(name, value) for name, value in m.items() if name.startswith(prefix)]
            if not rows:
                continue
            table = Table(heading, "", box=None, pad_edge=False, header_style="bold cyan")
            for name, value in rows[:_MAX_ROWS]:
                is_share = prefix == "Episode_Termination/" or name in ("Train/success_rate", "Eval/success_rate")
                table.add_row(Text(plain(name.partition("/")[2])), f"{value:.1%}" if is_share else f"{value:.4g}")
            tables.append(table)
        notes = Text("\n".join(map(plain, filter(None, [progress.no_episode, *progress.notes]))), style="yellow")
        return Group(head, Columns(tables, padding=(0, 4)), notes)


def _line(progress: Progress) -> str:
    parts = [_iteration(progress), f"{progress.env_steps} steps", f"{progress.steps_per_s:.0f} steps/s"]
    for name, word, form in _LINE_METRICS:
        if name in progress.metrics:
            parts.append(f"{word} {progress.metrics[name]:{form}}")
    if progress.no_episode:
        parts.append(f"({progress.no_episode})")
    return "  ".join([*parts, _left(progress)])


def _iteration(progress: Progress) -> str:
    return f"iteration {progress.iteration}/{'?' if progress.iterations is None else progress.iterations}"


def _left(progress: Progress) -> str:
    most = "at most " if progress.may_end_earlier and progress.remaining_s is not None else ""
    return f"{most}{'?' if progress.remaining_s is None else duration_text(progress.remaining_s)} left"


def duration_text(seconds: float) -> str:
    """Return a duration [s] as `m:ss`, or `h:mm:ss` from one hour on; `?` if it is negative, or 1e10 s or longer."""
    if not 0.0 <= seconds < _MAX_S:
        return "?"
    minutes, left = divmod(int(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{left:02}" if minutes >= 60 else f"{minutes}:{left:02}"

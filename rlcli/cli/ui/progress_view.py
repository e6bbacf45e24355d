"""Views of running trainings: a live table on a terminal, else a line every few seconds."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Sequence
from typing import Any, Self

from rlcli.cli.ui.console import console, plain
from rlcli.cli.ui.tables import flow
from rlcli.cli.ui.terminal import is_terminal, screen
from rlcli.training.progress import PARTS, Progress

LINE_EVERY_S = 5.0
_MAX_ROWS = 100
"""Rows of one table; an untrusted run may have any number of metrics."""
_MAX_S = 1e10
"""Longest time that is shown [s]."""
_LINE_METRICS = (
    ("Train/mean_reward", "return", ".3f"),
    ("Train/mean_episode_length", "length", ".0f"),
    ("Train/success_rate", "success", ".1%"),
)


class LiveView:
    """Context with a block of lines on stderr that is redrawn; without a terminal there is no block."""

    def __init__(self, **options: Any) -> None:
        self._options = options
        self._live: Any = None

    def __enter__(self) -> Self:
        if is_terminal(sys.stderr) and not console.quiet:
            from rich.live import Live

            self._live = Live(console=screen(sys.stderr), **self._options)
            self._live.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        if self._live is not None:
            with contextlib.suppress(OSError):  # the terminal may be closed
                self._live.__exit__(*error)

    def update(self, lines: Sequence[str], *, refresh: bool = False) -> None:
        """Replace the lines of the block."""
        from rich.text import Text

        self._live.update(Text("\n".join(lines)), refresh=refresh)


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
        """Show one iteration."""
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
        head = Text.assemble(("\n".join(flow(state, width)), "bold"), "\n", ("\n".join(flow(split, width)), "dim"))
        tables = []
        for heading, prefix in (
            ("training", "Train/"),
            ("reward terms", "Episode_Reward/"),
            ("terminations", "Episode_Termination/"),
            ("learner", ("Loss/", "Policy/")),
        ):
            rows = [(name, value) for name, value in m.items() if name.startswith(prefix)]
            if not rows:
                continue
            table = Table(heading, "", box=None, pad_edge=False, header_style="bold cyan")
            for name, value in rows[:_MAX_ROWS]:
                is_share = prefix == "Episode_Termination/" or (name.endswith("_rate") and prefix == "Train/")
                table.add_row(Text(plain(name.partition("/")[2])), f"{value:.1%}" if is_share else f"{value:.4g}")
            tables.append(table)
        notes = Text(plain("\n".join(progress.notes)), style="yellow")
        return Group(head, Columns(tables, padding=(0, 4)), notes)


def _line(progress: Progress) -> str:
    parts = [_iteration(progress), f"{progress.env_steps} steps", f"{progress.steps_per_s:.0f} steps/s"]
    for name, word, form in _LINE_METRICS:
        if name in progress.metrics:
            parts.append(f"{word} {progress.metrics[name]:{form}}")
    return "  ".join([*parts, _left(progress)])


def _iteration(progress: Progress) -> str:
    return f"iteration {progress.iteration}/{'?' if progress.iterations is None else progress.iterations}"


def _left(progress: Progress) -> str:
    return f"{'?' if progress.remaining_s is None else clock(progress.remaining_s)} left"


def clock(seconds: float) -> str:
    """Return a time as hours, minutes and seconds; `?` for a negative or endless one."""
    if not 0.0 <= seconds < _MAX_S:
        return "?"
    minutes, left = divmod(int(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{left:02}" if minutes >= 60 else f"{minutes}:{left:02}"

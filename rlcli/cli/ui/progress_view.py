"""The view of a running training: a live table on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import contextlib
import sys
import time
from typing import Any, Self

from rlcli.cli.ui.console import console, plain
from rlcli.cli.ui.tables import flow
from rlcli.cli.ui.terminal import is_terminal, screen
from rlcli.training.progress import PARTS, Progress

LINE_EVERY_S = 5.0
_MOST_ROWS = 100
"""Of a table: metrics may be a stranger's."""
_LONGEST_S = 1e10
"""No training takes longer."""
_LINE_METRICS = (
    ("Train/mean_reward", "return", ".3f"),
    ("Train/mean_episode_length", "length", ".0f"),
    ("Train/success_rate", "success", ".1%"),
)


class LiveView:
    """Context with a block on stderr that is redrawn, if stderr is a terminal."""

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
            with contextlib.suppress(OSError):  # the terminal may be gone
                self._live.__exit__(*error)


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
        """Take in one iteration."""
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
        stands = [self._title, _iteration(progress), *speed, _left(progress)]
        width = self._live.console.width
        head = Text.assemble(("\n".join(flow(stands, width)), "bold"), "\n", ("\n".join(flow(split, width)), "dim"))
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
            for name, value in rows[:_MOST_ROWS]:
                is_share = prefix == "Episode_Termination/" or (name.endswith("_rate") and prefix == "Train/")
                table.add_row(Text(plain(name.partition("/")[2])), f"{value:.1%}" if is_share else f"{value:.4g}")
            tables.append(table)
        return Group(head, Columns(tables, padding=(0, 4)))


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
    """Hours, minutes and seconds; of what no training has taken, a question mark."""
    if not 0.0 <= seconds < _LONGEST_S:
        return "?"
    minutes, left = divmod(int(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{left:02}" if minutes >= 60 else f"{minutes}:{left:02}"

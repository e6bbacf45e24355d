"""The view of a running training: a live table on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import contextlib
import sys
import time
from types import TracebackType
from typing import Any

from rlcli.cli.console import console, is_terminal, plain
from rlcli.cli.tables import flow, screen
from rlcli.rl.progress import PARTS, Progress

LINE_EVERY_S = 5.0
_MOST_ROWS = 100
"""Of a table: metrics may be a stranger's."""
_LONGEST_S = 1e10
"""No training takes longer."""


class TrainingView:
    """Shows progress on stderr; used as a context."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._live: Any = None
        self._last_line = 0.0
        self._last: Progress | None = None

    def __enter__(self) -> TrainingView:
        if is_terminal(sys.stderr) and not console.quiet:
            from rich.live import Live

            self._live = Live(console=screen(sys.stderr), refresh_per_second=8, transient=False)
            self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            with contextlib.suppress(OSError):  # the terminal may be gone
                self._live.__exit__(kind, error, trace)
        elif self._last is not None:
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
        stands = [
            self._title,
            _iteration(progress),
            f"{progress.env_steps:,} steps",
            f"{progress.steps_per_s:,.0f} steps/s",
            _left(progress),
        ]
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
                text = (
                    f"{value:.1%}"
                    if prefix == "Episode_Termination/" or (name.endswith("_rate") and prefix == "Train/")
                    else f"{value:.4g}"
                )
                table.add_row(Text(plain(name.partition("/")[2])), text)
            tables.append(table)
        return Group(head, Columns(tables, padding=(0, 4)))


def _line(progress: Progress) -> str:
    m = progress.metrics
    parts = [
        _iteration(progress),
        f"{progress.env_steps} steps",
        f"{progress.steps_per_s:.0f} steps/s",
    ]
    if "Train/mean_reward" in m:
        parts.append(f"return {m['Train/mean_reward']:.3f}")
    if "Train/mean_episode_length" in m:
        parts.append(f"length {m['Train/mean_episode_length']:.0f}")
    if "Train/success_rate" in m:
        parts.append(f"success {m['Train/success_rate']:.1%}")
    parts.append(_left(progress))
    return "  ".join(parts)


def _iteration(progress: Progress) -> str:
    return f"iteration {progress.iteration}/{'?' if progress.iterations is None else progress.iterations}"


def _left(progress: Progress) -> str:
    return f"{'?' if progress.remaining_s is None else clock(progress.remaining_s)} left"


def clock(seconds: float) -> str:
    """Hours, minutes and seconds; of what no training has taken, a question mark."""
    if not 0.0 <= seconds < _LONGEST_S:
        return "?"
    whole = int(seconds)
    return (
        f"{whole // 3600}:{whole % 3600 // 60:02}:{whole % 60:02}"
        if whole >= 3600
        else f"{whole // 60}:{whole % 60:02}"
    )

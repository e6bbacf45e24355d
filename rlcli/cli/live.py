"""The view of a running training: a live table on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import contextlib
import sys
import time
from types import TracebackType
from typing import Any

from rlcli.cli.console import console
from rlcli.rl.train import Progress

LINE_EVERY_S = 5.0
_PARTS = ("physics", "task", "policy", "update")


class TrainingView:
    """Shows progress on stderr; used as a context."""

    def __init__(self, title: str) -> None:
        self._title = title
        self._live: Any = None
        self._last_line = 0.0
        self._last: Progress | None = None

    def __enter__(self) -> TrainingView:
        if sys.stderr.isatty() and not console.quiet:
            from rich.console import Console as Rich
            from rich.live import Live

            self._live = Live(console=Rich(stderr=True), refresh_per_second=8, transient=False)
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
        split = "  ".join(f"{part} {progress.seconds.get(part, 0.0) / total:4.0%}" for part in _PARTS)
        head = Text.assemble(
            (self._title, "bold"),
            f"   iteration {progress.iteration}/{progress.iterations}   {progress.env_steps:,} steps"
            f"   {progress.steps_per_s:,.0f} steps/s   {_clock(progress.remaining_s)} left\n",
            (split, "dim"),
        )
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
            for name, value in rows:
                text = (
                    f"{value:.1%}"
                    if prefix == "Episode_Termination/" or (name.endswith("_rate") and prefix == "Train/")
                    else f"{value:.4g}"
                )
                table.add_row(name.partition("/")[2], text)
            tables.append(table)
        return Group(head, Columns(tables, padding=(0, 4)))


def _line(progress: Progress) -> str:
    m = progress.metrics
    parts = [
        f"iteration {progress.iteration}/{progress.iterations}",
        f"{progress.env_steps} steps",
        f"{progress.steps_per_s:.0f} steps/s",
    ]
    if "Train/mean_reward" in m:
        parts.append(f"return {m['Train/mean_reward']:.3f}")
        parts.append(f"length {m['Train/mean_episode_length']:.0f}")
    if "Train/success_rate" in m:
        parts.append(f"success {m['Train/success_rate']:.1%}")
    parts.append(f"{_clock(progress.remaining_s)} left")
    return "  ".join(parts)


def _clock(seconds: float) -> str:
    whole = int(seconds)
    return (
        f"{whole // 3600}:{whole % 3600 // 60:02}:{whole % 60:02}"
        if whole >= 3600
        else f"{whole // 60}:{whole % 60:02}"
    )

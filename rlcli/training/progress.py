"""Where a training stands, for whoever shows it; light, so that another process can show it too."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

PARTS = ("physics", "task", "policy", "update")
"""What the seconds of an iteration are split into."""
_FOREVER_S = 1e10
"""What is further away than that [s] is not foreseen."""


@dataclass(slots=True)
class Progress:
    """Where training stands."""

    iteration: int
    iterations: int | None
    """Iterations in all, where that is known."""
    env_steps: int
    elapsed_s: float
    remaining_s: float | None
    steps_per_s: float
    seconds: dict[str, float]
    metrics: dict[str, float]


def progress_of(rows: Sequence[Mapping[str, Any]], iterations: int | None, elapsed_s: float) -> Progress:
    """The same from the newest rows of `metrics.jsonl`, at least one; the rate is that of all of them.

    Args:
        rows: the rows, oldest first.
        iterations: iterations in all, where that is known.
        elapsed_s: how long the run has trained.
    """
    last = rows[-1]
    metrics = {name: value for name, value in last.items() if type(value) is float or type(value) is int}
    for name in ("iteration", "step"):
        metrics.pop(name, None)
    took = sum(_number(row, "Perf/collection_time") + _number(row, "Perf/learning_time") for row in rows)
    before = rows[0]["step"] - rows[0]["step"] // max(1, rows[0]["iteration"])
    rate = (last["step"] - before) / took if took > 0.0 else 0.0
    one = last["step"] / max(1, last["iteration"])
    left = None
    if iterations is not None and rate > 0.0:
        done = max(1, last["iteration"])
        left = max(0, iterations - done) * max(one / rate, elapsed_s / done)  # rows leave clips and checkpoints out
    if left is not None and not left < _FOREVER_S:
        left = None
    seconds = {part: _number(last, f"Perf/{part}_share") for part in PARTS}
    return Progress(last["iteration"], iterations, last["step"], elapsed_s, left, rate, seconds, metrics)


def _number(row: Mapping[str, Any], name: str) -> float:
    value = row.get(name, 0.0)
    return float(value) if type(value) in (int, float) and value >= 0.0 else 0.0

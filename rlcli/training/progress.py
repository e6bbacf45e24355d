"""Progress of a training, for display by `train`, `watch` and others. The module imports neither torch nor MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

PARTS = ("physics", "task", "policy", "update")
"""Parts of an iteration whose durations are measured."""
_FOREVER_S = 1e10
"""Longest remaining time that is displayed [s]."""


@dataclass(slots=True)
class Progress:
    """Progress of a training after an iteration, for display."""

    iteration: int
    iterations: int | None
    """Iterations of the whole training; None: unknown."""
    env_steps: int
    elapsed_s: float
    remaining_s: float | None
    """Estimated remaining time [s]; None: unknown."""
    steps_per_s: float
    seconds: dict[str, float]
    """Part of an iteration -> its duration [s], or its share of the iteration."""
    metrics: dict[str, float]
    notes: Sequence[str] = ()
    """Conditions of success with their values, and findings of the health checks."""


def progress_from_metrics(rows: Sequence[Mapping[str, Any]], iterations: int | None, elapsed_s: float) -> Progress:
    """Return the progress of a run from the newest rows of its `metrics.jsonl`; the speed is the mean over these rows.

    Args:
        rows: the rows, at least one, oldest first.
        iterations: iterations of the whole training; None: unknown.
        elapsed_s: duration of the training so far [s].
    """
    last = rows[-1]
    metrics = {k: v for k, v in last.items() if type(v) in (int, float) and k not in ("iteration", "step")}
    duration = sum(_number(row, "Perf/collection_time") + _number(row, "Perf/learning_time") for row in rows)
    # steps before the iteration of the first row, whose duration counts, too
    before = rows[0]["step"] - rows[0]["step"] // max(1, rows[0]["iteration"])
    rate = (last["step"] - before) / duration if duration > 0.0 else 0.0
    steps_per_iteration = last["step"] / max(1, last["iteration"])
    left = None
    if iterations is not None and rate > 0.0:
        done = max(1, last["iteration"])
        # the rows do not count the time of videos and checkpoints, `elapsed_s` does
        left = max(0, iterations - done) * max(steps_per_iteration / rate, elapsed_s / done)
        left = left if left < _FOREVER_S else None
    seconds = {part: _number(last, f"Perf/{part}_share") for part in PARTS}
    return Progress(last["iteration"], iterations, last["step"], elapsed_s, left, rate, seconds, metrics)


def _number(row: Mapping[str, Any], name: str) -> float:
    """Return the metric `name` of a row of an untrusted file; 0 if it is not a number of at least 0."""
    value = row.get(name, 0.0)
    return float(value) if type(value) in (int, float) and value >= 0.0 else 0.0

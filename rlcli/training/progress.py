"""Progress of a training (iteration, speed, remaining time), for display by `rlcli train` and `rlcli watch`.

The module imports neither torch nor MuJoCo.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

PARTS = ("physics", "task", "policy", "update")
"""Parts of an iteration whose durations are measured."""
_RETURN = "Train/mean_reward"
_FOREVER_S = 1e10
"""Largest remaining time that is displayed [s]; a longer time counts as unknown."""


@dataclass(slots=True)
class Progress:
    """Progress of a training after an iteration, for display."""

    iteration: int
    iterations: int | None
    """Iterations of the whole training; None: unknown."""
    env_steps: int
    remaining_s: float | None
    """Estimated remaining time [s]; None: unknown."""
    steps_per_s: float
    seconds: dict[str, float]
    """Part of an iteration -> its duration [s], or its share of the iteration."""
    metrics: dict[str, float]
    no_episode: str = ""
    """Note that no episode has ended in the newest iterations, so that `Train/*` are of older episodes; else empty."""
    may_end_earlier: bool = False
    """Whether the training may end before its budget, because of a threshold (`--until`)."""
    notes: Sequence[str] = ()
    """Conditions of success with their values, and findings of the health checks."""


def progress_from_metrics(rows: Sequence[Mapping[str, Any]], iterations: int | None) -> Progress:
    """Return the progress of a run from the newest rows of its `metrics.jsonl`.

    The speed is the mean over all rows except the oldest, because the first iteration of a training compiles code.

    Args:
        rows: the rows, at least one, oldest first.
        iterations: iterations of the whole training; None: unknown.
    """
    last, newer = rows[-1], rows[1:] or rows
    metrics = {k: v for k, v in last.items() if type(v) in (int, float) and k not in ("iteration", "step")}
    duration = sum(map(_iteration_s, newer))
    # steps before the iteration of the first row whose duration counts
    before = rows[0]["step"] if len(rows) > 1 else last["step"] - last["step"] // max(1, last["iteration"])
    rate = (last["step"] - before) / duration if duration > 0.0 else 0.0
    left = None
    if iterations is not None and rate > 0.0:
        left = max(0, iterations - last["iteration"]) * duration / len(newer)
        left = left if left < _FOREVER_S else None
    seconds = {part: _number(last, f"Perf/{part}_share") for part in PARTS}
    note = no_episode_note(rows)
    return Progress(last["iteration"], iterations, last["step"], left, rate, seconds, metrics, note)


def no_episode_note(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a note if no episode has ended in the newest iterations; an empty text if one ended in the last one.

    An iteration in which episodes have ended has metrics `Episode_*`; without them, `Train/*` repeat older values.

    Args:
        rows: rows of `metrics.jsonl`, at least one, the oldest first.
    """
    if _RETURN not in rows[-1]:
        return "no episode has ended yet"
    newest = itertools.takewhile(lambda row: not any(name.startswith("Episode_") for name in row), reversed(rows))
    count = sum(1 for row in newest if row.get(_RETURN) == rows[-1][_RETURN])
    least = "at least " if count == len(rows) else ""
    text = f"no episode ended for {least}{count} iteration{'s' * (count != 1)}, so the figures are of older episodes"
    return text if count else ""


def _iteration_s(row: Mapping[str, Any]) -> float:
    """Return the duration of an iteration [s]; for runs of older versions, without videos and checkpoints."""
    measured = _number(row, "Perf/iteration_time")
    return measured or _number(row, "Perf/collection_time") + _number(row, "Perf/learning_time")


def _number(row: Mapping[str, Any], name: str) -> float:
    """Return the metric `name` of a row of an untrusted file; 0 if it is not a number of at least 0."""
    value = row.get(name, 0.0)
    return float(value) if type(value) in (int, float) and value >= 0.0 else 0.0

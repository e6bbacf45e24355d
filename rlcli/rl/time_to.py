"""How long a training takes until its policy is good enough, by the evaluations between its iterations."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rlcli.errors import UsageError

_METRICS = {"success": "Eval/success_rate", "return": "Eval/mean_reward", "length": "Eval/mean_episode_length"}


@dataclass(frozen=True, slots=True)
class Bar:
    """What a policy must reach in an evaluation."""

    key: str
    """success, return or length."""
    value: float

    def reached_by(self, row: Mapping[str, Any]) -> bool:
        """Whether an evaluation after this iteration reached it."""
        return bool(row.get(_METRICS[self.key], -math.inf) >= self.value)


@dataclass(frozen=True, slots=True)
class Reached:
    """When a training reached its bar."""

    seconds: float
    """Rollouts and updates until then, added up; evaluations are not in it [s]."""
    step: int
    """Environment steps."""
    iteration: int


def read_bar(text: str) -> Bar:
    """`success=0.99`, `return=200`, `length=250`.

    Raises:
        UsageError: for anything else.
    """
    key, _, number = text.partition("=")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if key not in _METRICS or not math.isfinite(value):
        raise UsageError(f"--until '{text}' is no bar", hint="as in --until success=0.99, return=200 or length=250")
    if key == "success" and not 0.0 < value <= 1.0:
        raise UsageError(f"--until '{text}': a success rate is above 0 and at most 1")
    return Bar(key, value)


def training_s(row: Mapping[str, Any]) -> float:
    """What the rollout and the update of an iteration took [s]."""
    return float(row.get("Perf/collection_time", 0.0) + row.get("Perf/learning_time", 0.0))


def time_to(rows: Iterable[Mapping[str, Any]], bar: Bar) -> Reached | None:
    """When a training first reached a bar, by its metrics from the first iteration on; None if it has not."""
    seconds = 0.0
    for row in rows:
        seconds += training_s(row)
        if bar.reached_by(row):
            return Reached(seconds, row["step"], row["iteration"])
    return None


def median(values: Sequence[float | None]) -> float | None:
    """Of several seeds; a seed that never arrived (None) is later than any other, and so may the median be None."""
    found = statistics.median([math.inf if value is None else value for value in values])
    return found if math.isfinite(found) else None

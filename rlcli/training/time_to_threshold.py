"""Threshold of the option `--until KEY=X`, which ends a training, and measurement of the time to reach it."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rlcli.config.schema import parse_threshold
from rlcli.errors import UsageError

_METRICS = {"success": "Eval/success_rate", "return": "Eval/mean_reward", "length": "Eval/mean_episode_length"}


@dataclass(frozen=True, slots=True)
class Threshold:
    """Threshold of the option `--until KEY=X`, which the mean of an evaluation must reach."""

    key: str
    """Metric of the evaluation: success, return or length."""
    value: float
    """Smallest mean of the metric that reaches the threshold."""

    def reached_by(self, row: Mapping[str, Any]) -> bool:
        """Return whether the evaluation in a row of `metrics.jsonl` reached the threshold; False without evaluation."""
        return bool(row.get(_METRICS[self.key], -math.inf) >= self.value)

    def is_certain(self, summary: Mapping[str, Any]) -> bool:
        """Return whether the lower end of the 95 % interval in an evaluation's summary reaches the threshold."""
        low = summary[self.key]["low"] if self.key in summary else None
        return low is not None and low >= self.value

    def episodes(self, least: int) -> int:
        """Return a number of evaluation episodes, at least `least`, for which `is_certain` can be true."""
        if self.key != "success":
            return max(least, 2)
        from rlcli.rl.confidence import NORMAL  # imports numpy

        # Wilson's lower end with n of n successes is n / (n + z^2); twice as many episodes leave room for failures
        return max(least, 2 * math.ceil(NORMAL * NORMAL * self.value / (1.0 - self.value)))


@dataclass(frozen=True, slots=True)
class TimeToThreshold:
    """Time, environment steps and iteration at which a training reached its threshold."""

    seconds: float
    """Time of all rollouts and updates until the threshold was reached, without evaluations [s]."""
    step: int
    """Number of environment steps until then."""
    iteration: int


def read_threshold(text: str) -> Threshold:
    """Parse the value of the option `--until`, such as `success=0.95`.

    Raises:
        UsageError: if the text is not KEY=X with a known metric and an allowed number.
    """
    try:
        return Threshold(*parse_threshold(text))
    except ValueError as error:
        raise UsageError(f"--until {error}") from None


def training_s(row: Mapping[str, Any]) -> float:
    """Return the time of the rollout and the update of an iteration [s]."""
    return float(row.get("Perf/collection_time", 0.0) + row.get("Perf/learning_time", 0.0))


def time_to_threshold(rows: Iterable[Mapping[str, Any]], threshold: Threshold) -> TimeToThreshold | None:
    """Return when an evaluation of a training first reached a threshold; None if none did.

    `rows` are all rows of the run's `metrics.jsonl`, oldest first.
    """
    seconds = 0.0
    for row in rows:
        seconds += training_s(row)
        if threshold.reached_by(row):
            return TimeToThreshold(seconds, row["step"], row["iteration"])
    return None


def median(values: Sequence[float | None]) -> float | None:
    """Return the median, over seeds, of the times to the threshold.

    A value is None if that training did not reach the threshold; the result is None if half of the trainings did not.
    """
    found = statistics.median([math.inf if value is None else value for value in values])
    return found if math.isfinite(found) else None

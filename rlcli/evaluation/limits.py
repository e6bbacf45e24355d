"""Limits for the metrics of an evaluation, such as `--fail-under success=0.99`.

`rlcli eval` and `rlcli stress` fail with exit code 9 if a limit is missed.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rlcli.errors import UsageError, did_you_mean, listing
from rlcli.safe_text import float_or_nan

if TYPE_CHECKING:
    from rlcli.config.load import Resolved

_KEYS = ("success", "return", "length")
_GROUPS = ("reward_terms", "terminations", "values")
_WORD = re.compile(r"[A-Za-z_][\w./-]*")


@dataclass(frozen=True, slots=True)
class Limit:
    """Limit of a metric of an evaluation, from `--fail-under KEY=X` (a minimum) or `--fail-over KEY=X`."""

    key: str
    """success, return or length, or the name of a metric; with `.low` or `.high` an end of its 95 % interval."""
    value: float
    is_minimum: bool = True

    @property
    def flag(self) -> str:
        """The option that sets the limit."""
        return "--fail-under" if self.is_minimum else "--fail-over"

    @property
    def end(self) -> str:
        """Which end of the 95 % interval the option can limit, as in `success.low`: low for a minimum, else high."""
        return "low" if self.is_minimum else "high"

    def value_in(self, summary: Mapping[str, Any]) -> float | None:
        """Return the value of the limited metric in the summary of an evaluation (`Evaluation.summary`).

        Return None if there are too few episodes for an interval, or if a value is not finite.

        Raises:
            UsageError: if the evaluation has no such metric.
        """
        head, _, rest = self.key.partition(".")
        if head in _KEYS:
            entry, of_interval = summary[head], bool(rest)
        else:
            group, name = (head, rest) if head in _GROUPS else ("values", self.key)
            full_name, stem = _find_name(summary[group], name), name.removesuffix(f".{self.end}")
            found = full_name or _find_name(summary[group], stem)
            if found is None:
                raise self._unknown_metric_error(summary[group], group, stem)
            entry, of_interval = summary[group][found], full_name is None
        value: float | None = entry[self.end] if of_interval else mean_or_rate(entry)
        return value

    def failure(self, summary: Mapping[str, Any]) -> str | None:
        """Return the sentence that says why an evaluation fails this limit; None if the evaluation passes."""
        value = self.value_in(summary)
        if value is None:
            return (
                f"{self.key} is unknown, because there are fewer than two episodes or values that are not finite;"
                f" the limit is {self.value:g}"
            )
        if self.is_minimum and value < self.value:
            return f"{self.key} is {value:.6g}, below {self.value:g}"
        if not self.is_minimum and value > self.value:
            return f"{self.key} is {value:.6g}, above {self.value:g}"
        return None

    def _unknown_metric_error(self, entries: Mapping[str, Any], group: str, name: str) -> UsageError:
        option = f"{self.flag} {self.key}={self.value:g}"
        if group != "values":
            hint = did_you_mean(name, entries) or f"allowed: {listing(entries)}"
            return UsageError(f"{option}: the evaluation has no '{name}' in {group}", hint=hint)
        if same := _ending_in(entries, name):
            return UsageError(f"{option}: several metrics end in '{name}'", hint=f"write one of {listing(same)}")
        names = [*_KEYS, *entries]
        hint = did_you_mean(name, names) or f"allowed: {listing(names)}"
        return UsageError(f"{option}: the evaluation has no metric '{name}'", hint=hint)


def read_limits(fail_under: Sequence[str] | None, fail_over: Sequence[str] | None = None) -> list[Limit]:
    """Return the limits of an evaluation from the values `KEY=X` of the options `--fail-under` and `--fail-over`.

    If an option is repeated with the same key, its last value counts.

    Raises:
        UsageError: if a value is not of the form KEY=X.
    """
    limits = {}
    for texts, is_minimum in ((fail_under or (), True), (fail_over or (), False)):
        for text in texts:
            limit = _parse(text, is_minimum)
            limits[limit.key, is_minimum] = limit
    return list(limits.values())


def require_success(resolved: Resolved, keys: Iterable[str], instead: str = "--fail-under return=X") -> None:
    """Check that the task defines success if one of the metrics `keys` is the success rate.

    Args:
        resolved: the task.
        keys: the metrics, such as `success` or `return`.
        instead: options without `success`, for the hint.

    Raises:
        UsageError: if a metric is `success` and the task does not define success.
    """
    if any(key.partition(".")[0] == "success" for key in keys) and not resolved.task.success:
        hint = f"add `success:` to the task's YAML, or write {instead}"
        raise UsageError("the task defines no condition of success, so it has no success rate", hint=hint)


def failures(summary: Mapping[str, Any], limits: Iterable[Limit]) -> list[str]:
    """Return a sentence for each limit that the summary of an evaluation (`Evaluation.summary`) fails.

    Raises:
        UsageError: if the evaluation has no metric that a limit names.
    """
    return [failure for limit in limits if (failure := limit.failure(summary)) is not None]


def mean_or_rate(entry: Mapping[str, Any]) -> Any:
    """Return the value of one metric from its entry in the summary of an evaluation: its rate or its mean."""
    return entry["rate"] if "rate" in entry else entry["mean"]


def _parse(text: str, is_minimum: bool) -> Limit:
    key, _, number = text.partition("=")
    limit = Limit(key, float_or_nan(number), is_minimum)
    if not math.isfinite(limit.value) or not _is_key(limit):
        end = "lower" if is_minimum else "upper"
        raise UsageError(
            f"{limit.flag} '{text}' is not METRIC=X with a number X",
            hint="METRIC is success, return, length, or a metric that `rlcli eval` prints, such as reward_terms.alive"
            f" or terminations.time_out; METRIC.{limit.end}=X limits the {end} end of its 95 % interval",
        )
    return limit


def _is_key(limit: Limit) -> bool:
    """Return whether the key of a limit is well-formed. Whether its metric exists is known only after an evaluation."""
    head, _, rest = limit.key.partition(".")
    if head in _KEYS:
        return rest in ("", limit.end)
    if head in _GROUPS:
        return bool(rest) and not any(letter.isspace() for letter in rest)
    return bool(_WORD.fullmatch(limit.key)) and not difflib.get_close_matches(head, _KEYS, cutoff=0.8)


def _find_name(entries: Mapping[str, Any], name: str) -> str | None:
    """Return the full name of a metric: `name`, or `command/name` if exactly one command has a metric `name`.

    Return None if there is no such metric, or if several commands have it.
    """
    if name in entries:
        return name
    same = _ending_in(entries, name)
    return same[0] if len(same) == 1 else None


def _ending_in(entries: Mapping[str, Any], name: str) -> list[str]:
    return [entry for entry in entries if entry.rpartition("/")[2] == name]

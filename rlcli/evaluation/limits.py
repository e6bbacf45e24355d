"""Limits of an evaluation: `--fail-under success=0.99` and `--fail-over error_vel_xy=0.25`."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rlcli.errors import UsageError, did_you_mean, listing

if TYPE_CHECKING:
    from rlcli.config.load import Resolved

_KEYS = ("success", "return", "length")
_GROUPS = ("reward_terms", "terminations", "values")
_WORD = re.compile(r"[A-Za-z_][\w./-]*")


@dataclass(frozen=True, slots=True)
class Limit:
    """Smallest or largest accepted value of one number of an evaluation."""

    key: str
    value: float
    is_minimum: bool = True

    @property
    def flag(self) -> str:
        """The option that sets such a limit."""
        return "--fail-under" if self.is_minimum else "--fail-over"

    @property
    def end(self) -> str:
        """The end of an interval that the option compares: KEY.low or KEY.high."""
        return "low" if self.is_minimum else "high"

    def value_in(self, summary: Mapping[str, Any]) -> float | None:
        """Return the number that the key stands for; None where it is unknown.

        Raises:
            UsageError: if the evaluation has no such term or value.
        """
        head, _, rest = self.key.partition(".")
        if head in _KEYS:
            entry, of_interval = summary[head], bool(rest)
        else:
            group, name = (head, rest) if head in _GROUPS else ("values", self.key)
            whole, stem = _find_name(summary[group], name), name.removesuffix(f".{self.end}")
            found = whole or _find_name(summary[group], stem)
            if found is None:
                raise self._unknown(summary[group], group, stem)
            entry, of_interval = summary[group][found], whole is None
        value: float | None = entry[self.end] if of_interval else mean_or_rate(entry)
        return value

    def failure(self, summary: Mapping[str, Any]) -> str | None:
        """Return why an evaluation fails this limit; None if it holds."""
        value = self.value_in(summary)
        if value is None:
            return f"{self.key} is not known from one episode, and {self.value:g} is asked for"
        if self.is_minimum and value < self.value:
            return f"{self.key} is {value:.6g}, below {self.value:g}"
        if not self.is_minimum and value > self.value:
            return f"{self.key} is {value:.6g}, above {self.value:g}"
        return None

    def _unknown(self, entries: Mapping[str, Any], group: str, name: str) -> UsageError:
        option = f"{self.flag} {self.key}={self.value:g}"
        if group != "values":
            hint = did_you_mean(name, entries) or f"there are: {listing(entries)}"
            return UsageError(f"{option}: there is no {group}.{name}", hint=hint)
        if same := _ending_in(entries, name):
            return UsageError(f"{option}: which of them?", hint=listing(same))
        names = [*_KEYS, *entries]
        hint = did_you_mean(name, names) or f"there are: {listing(names)}"
        return UsageError(f"{option}: the task logs no value '{name}'", hint=hint)


def read_limits(fail_under: Sequence[str] | None, fail_over: Sequence[str] | None = None) -> list[Limit]:
    """Parse `KEY=X` of `--fail-under` and `--fail-over`; of two for one key the last one holds.

    Raises:
        UsageError: for anything else.
    """
    limits = {}
    for texts, is_minimum in ((fail_under or (), True), (fail_over or (), False)):
        for text in texts:
            limit = _parse(text, is_minimum)
            limits[limit.key, is_minimum] = limit
    return list(limits.values())


def require_success(resolved: Resolved, keys: Iterable[str]) -> None:
    """Check that the task defines success if one of the keys is about it.

    Raises:
        UsageError: if it does not.
    """
    if any(key.partition(".")[0] == "success" for key in keys) and resolved.task.success is None:
        raise UsageError("this task defines no success", hint="add `success:` to its YAML, or use return=X")


def failures(summary: Mapping[str, Any], limits: Iterable[Limit]) -> list[str]:
    """Return which limits an evaluation fails, one sentence each.

    Raises:
        UsageError: if the evaluation has no such term or value.
    """
    return [failure for limit in limits if (failure := limit.failure(summary)) is not None]


def mean_or_rate(entry: Mapping[str, Any]) -> Any:
    """Return the number in the middle of an interval: a share's rate, else the mean."""
    return entry["rate"] if "rate" in entry else entry["mean"]


def _parse(text: str, is_minimum: bool) -> Limit:
    key, _, number = text.partition("=")
    try:
        limit = Limit(key, float(number), is_minimum)
    except ValueError:
        limit = Limit(key, math.nan, is_minimum)
    if not math.isfinite(limit.value) or not _is_key(limit):
        end = "lower" if is_minimum else "upper"
        raise UsageError(
            f"{limit.flag} '{text}' is not success=X, return=X, length=X or NAME=X",
            hint="NAME: a value of the task, reward_terms.NAME or terminations.NAME;"
            f" KEY.{limit.end}=X is of the interval's {end} end",
        )
    return limit


def _is_key(limit: Limit) -> bool:
    """Whether a key may stand for a number; only an evaluation shows whether the task has a value of that name."""
    head, _, rest = limit.key.partition(".")
    if head in _KEYS:
        return rest in ("", limit.end)
    if head in _GROUPS:
        return bool(rest) and not any(letter.isspace() for letter in rest)
    return bool(_WORD.fullmatch(limit.key)) and not difflib.get_close_matches(head, _KEYS, cutoff=0.8)


def _find_name(entries: Mapping[str, Any], name: str) -> str | None:
    """The entry of this name; of `command/metric` the last part is enough where it is unique."""
    if name in entries:
        return name
    same = _ending_in(entries, name)
    return same[0] if len(same) == 1 else None


def _ending_in(entries: Mapping[str, Any], name: str) -> list[str]:
    return [entry for entry in entries if entry.rpartition("/")[2] == name]

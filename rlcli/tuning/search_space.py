"""Parsers for the search space (`--param`) and the objective (`--objective`) of a sweep."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rlcli.config import strict_yaml
from rlcli.config.dump import to_yaml
from rlcli.config.layers import parse_address, parse_override
from rlcli.config.strict_yaml import YamlError
from rlcli.errors import ConfigError, UsageError, listing

if TYPE_CHECKING:
    import optuna

_RANGE = re.compile(r"(log:)?([^:,\[\]]+):([^:,\[\]]+)")
_OBJECTIVE = re.compile(
    r"((?:success|return|length)|(?:reward_terms|terminations)\.[^@\s]+)"
    r"(?:@((?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e\+?[0-9]+)?)(s|steps)?)?"
)
_MAX_BOUND = {int: 2**53, float: 1e300}
"""Largest bounds of a range: a float represents each such integer exactly, and the width of a range is finite."""
HINT = "write --param KEY=LOW:HIGH, KEY=log:LOW:HIGH or KEY=A,B,C"


@dataclass(frozen=True, slots=True)
class Parameter:
    """Setting that a sweep varies: a key of the configuration, and the range or the choices of its values."""

    key: str
    """Dotted key of the configuration, such as `agent.learning_rate`."""
    low: float | int | None = None
    """Lower end of the range; None: the parameter has choices."""
    high: float | int | None = None
    """Upper end of the range (inclusive); None: the parameter has choices."""
    log: bool = False
    """Whether the logarithm of the value is searched."""
    choices: tuple[Any, ...] = ()
    """The allowed values; empty: the parameter has a range."""

    @property
    def bounds(self) -> tuple[Any, ...]:
        """Values to check before the sweep: the two ends of the range, or all choices."""
        return self.choices or (self.low, self.high)

    def override(self, value: object) -> str:
        """Return a value of the parameter as an override, `KEY=VALUE`."""
        return f"{self.key}={_to_line(value)}"

    def suggest(self, trial: optuna.Trial) -> Any:
        """Return the value that Optuna suggests for a trial (its type is that of the range's ends or of the choice)."""
        if self.choices:  # Optuna stores only scalars, so choices are stored as YAML text
            return self.value(trial.suggest_categorical(self.key, [_to_line(choice) for choice in self.choices]))
        suggest = trial.suggest_int if isinstance(self.low, int) else trial.suggest_float
        return suggest(self.key, *self.bounds, log=self.log)

    def is_valid(self, stored: object) -> bool:
        """Return whether a value that Optuna has stored is one of the choices (as YAML) or a number in the range."""
        if self.choices:
            return stored in [_to_line(choice) for choice in self.choices]
        return type(stored) in (int, float) and self.low <= stored <= self.high  # type: ignore[operator]

    def value(self, stored: Any) -> Any:
        """Return the value of a trial from what Optuna has stored: a number, or YAML text for a choice."""
        if not self.choices:
            return stored
        return self.choices[[_to_line(choice) for choice in self.choices].index(stored)]


@dataclass(frozen=True, slots=True)
class Objective:
    """Metric by which trials are ranked, and the length of each trial's training."""

    key: str
    """Entry in the JSON document of `rlcli eval`: success, return, length, reward_terms.NAME or terminations.NAME."""
    seconds: float | None = None
    """Training time after which a training is stopped [s]; None: no limit."""
    steps: int | None = None
    """Number of environment steps after which a training ends; None: the agent's budget."""

    def read(self, document: Mapping[str, Any]) -> float:
        """Return the metric from the JSON document of `rlcli eval`; NaN if the document has null as its value.

        Raises:
            UsageError: if the document does not have the metric.
        """
        first, _, name = self.key.partition(".")
        found = document.get(first)
        entry = found.get(name) if name and isinstance(found, dict) else found
        if not isinstance(entry, dict):
            known = listing(f"{first}.{key}" for key in found) if name and isinstance(found, dict) else ""
            message = f"--objective {self.key}: the evaluation of this task has no such result"
            raise UsageError(message, hint=f"choose from {known}" if known else "use return, success or length")
        value = entry["rate"] if "rate" in entry else entry["mean"]
        return math.nan if value is None else float(value)

    @property
    def training_metric(self) -> str | None:
        """Metric of a training that the pruner compares (`return` or `success`); None: trials are not pruned."""
        return self.key if self.key in ("return", "success") else None


def read_parameters(texts: Sequence[str]) -> list[Parameter]:
    """Parse the values of the repeated option `--param`: `KEY=LOW:HIGH`, `KEY=log:LOW:HIGH` or `KEY=A,B,C`.

    Raises:
        UsageError: for another form, an empty range, fewer than two choices, or a repeated key.
    """
    found = [_read(text) for text in texts]
    keys = [parse_address(parameter.key) for parameter in found]
    twice = next((key for key in keys if keys.count(key) > 1), None)
    if twice is not None:
        raise UsageError(f"--param {'.'.join(twice)} is given twice; leave out one")
    return found


def read_objective(text: str) -> Objective:
    """Parse the option `--objective`, such as `success@30s`, `return@2e6steps` or `return`.

    After `@` is the limit of the training: seconds, or environment steps.

    Raises:
        UsageError: for another metric, or a limit that is not a number between 0 and 1e12.
    """
    found = _OBJECTIVE.fullmatch(text)
    number = float(found[2] or 1.0) if found else 0.0
    if found is None or not 0.0 < number < 1e12:
        raise UsageError(
            f"--objective '{text}' is not valid",
            hint="write return, success, length, reward_terms.NAME or terminations.NAME, optionally with a length of"
            " training: success@30s (after 30 s of training) or success@2e6 (after 2,000,000 steps)",
        )
    if found[2] is None:
        return Objective(found[1])
    return Objective(found[1], seconds=number) if found[3] == "s" else Objective(found[1], steps=int(number))


def _read(text: str) -> Parameter:
    """Parse one value of the option `--param`; see `read_parameters` for the errors."""
    key, equals, ranges = text.partition("=")
    key = key.strip()
    if not equals or not key or not ranges.strip():
        raise UsageError(f"--param '{text}' has no key or no values", hint=HINT)
    try:
        parse_override(f"{key}=0")
    except ConfigError as error:
        raise UsageError(f"--param '{text}': {error.problems[0].message}", hint=HINT) from None
    span = _RANGE.fullmatch(ranges.strip())
    if span is None:
        return _choices(text, key, ranges)
    low, high = (_load(text, part.strip()) for part in span.groups()[1:])
    log = span[1] is not None
    if any(type(end) not in (int, float) or not abs(end) < _MAX_BOUND[type(end)] for end in (low, high)):
        message = f"--param '{text}': the ends of a range must be numbers below 1e300, or whole numbers below 2**53"
        raise UsageError(message, hint=HINT)
    if not low < high:
        raise UsageError(f"--param '{text}': LOW ({low}) must be below HIGH ({high})", hint=HINT)
    if log and low <= 0:
        raise UsageError(f"--param '{text}': a logarithmic range must start above 0", hint=HINT)
    if float in (type(low), type(high)):
        low, high = float(low), float(high)
    return Parameter(key, low, high, log)


def _choices(text: str, key: str, words: str) -> Parameter:
    """Parse the choices `A,B,C` of a key; `text` is the whole value of the option, for messages."""
    choices = _load(text, f"[{words}]")
    if not isinstance(choices, list) or len(choices) < 2:
        raise UsageError(f"--param '{text}' has fewer than two choices", hint=HINT)
    written = [_to_line(choice) for choice in choices]
    if len(set(written)) < len(written):
        raise UsageError(f"--param '{text}' has a choice twice; leave out one")
    return Parameter(key, choices=tuple(choices))


def _load(text: str, value: str) -> Any:
    """Parse a number or a list as YAML; `text` is the whole value of the option `--param`, for messages."""
    try:
        return strict_yaml.load_value(value)
    except YamlError as error:
        raise UsageError(f"--param '{text}': {error.message}", hint=HINT) from None


def _to_line(value: object) -> str:
    """Return a value as YAML on one line; lists, mappings and long text as JSON, which is YAML too."""
    text = to_yaml({"v": value})
    if isinstance(value, list | dict) or "\n" in text.strip():
        import json

        return json.dumps(value)  # JSON is YAML
    return text.strip().removeprefix("v:").strip()

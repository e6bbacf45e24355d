"""What a sweep draws, and what it judges its trials by, as the command line writes them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rlcli.config import strict_yaml
from rlcli.config.layers import parse_address, parse_override
from rlcli.config.strict_yaml import Path, YamlError
from rlcli.errors import ConfigError, UsageError, listing

_RANGE = re.compile(r"(log:)?([^:,\[\]]+):([^:,\[\]]+)")
_OBJECTIVE = re.compile(
    r"((?:success|return|length)|(?:reward_terms|terminations)\.[^@\s]+)(?:@([0-9.e+]+)(s|steps)?)?"
)
_LARGEST = {int: 2**53, float: 1e300}
"""Of a range: up to there floats hold every whole number, and the width of a range is a number."""
HINT = "KEY=LOW:HIGH, KEY=log:LOW:HIGH or KEY=A,B,C"


@dataclass(frozen=True, slots=True)
class Parameter:
    """One key of the configuration, and what is drawn for it."""

    key: str
    low: float | int | None = None
    high: float | int | None = None
    log: bool = False
    choices: tuple[Any, ...] = ()

    @property
    def bounds(self) -> tuple[Any, ...]:
        """Values that a configuration must be able to have: the ends, or each of the choices."""
        return self.choices or (self.low, self.high)

    def override(self, value: Any) -> str:
        """The value as an override of a command line."""
        return f"{self.key}={_written(value)}"

    def draw(self, trial: Any) -> Any:
        """A value that Optuna suggests."""
        if self.choices:  # Optuna stores scalars: of the others their text
            words = [_written(choice) for choice in self.choices]
            return self.choices[words.index(trial.suggest_categorical(self.key, words))]
        suggest = trial.suggest_int if isinstance(self.low, int) else trial.suggest_float
        return suggest(self.key, self.low, self.high, log=self.log)

    def value(self, stored: Any) -> Any:
        """The value of what Optuna stores of a trial."""
        if not self.choices:
            return stored
        return self.choices[[_written(choice) for choice in self.choices].index(stored)]


@dataclass(frozen=True, slots=True)
class Objective:
    """What a trial is judged by, and when."""

    key: str
    """Of the document of `rlcli eval`: success, return, length, reward_terms.NAME or terminations.NAME."""
    seconds: float | None = None
    """Training is stopped after so long [s]."""
    steps: int | None = None
    """Training ends after so many environment steps."""

    def read(self, document: Mapping[str, Any]) -> float:
        """Its value in the document of an evaluation; NaN where that was not finite.

        Raises:
            UsageError: if it is not in there.
        """
        first, _, name = self.key.partition(".")
        found = document.get(first)
        entry = found.get(name) if name and isinstance(found, dict) else found
        if not isinstance(entry, dict):
            told = listing(f"{first}.{key}" for key in found) if name and isinstance(found, dict) else ""
            raise UsageError(
                f"--objective {self.key}: the evaluation does not tell it",
                hint=f"there are: {told}" if told else "return, success or length",
            )
        value = entry["rate"] if "rate" in entry else entry["mean"]
        return math.nan if value is None else float(value)

    @property
    def told(self) -> str | None:
        """The metric of training that stands for it meanwhile."""
        return {"return": "return", "success": "success"}.get(self.key)


def read_parameters(texts: Sequence[str]) -> list[Parameter]:
    """`--param`, repeated.

    Raises:
        UsageError: for what is none, an empty range, or a key twice.
    """
    found = [_read(text) for text in texts]
    keys = [parse_address(parameter.key) for parameter in found]
    twice = next((key for key in keys if keys.count(key) > 1), None)
    if twice is not None:
        raise UsageError(f"--param names {'.'.join(twice)} twice")
    return found


def read_objective(text: str) -> Objective:
    """`success@30s`, `return@2e6steps`, `return`.

    Raises:
        UsageError: for anything else.
    """
    found = _OBJECTIVE.fullmatch(text)
    try:
        if found is None:
            raise ValueError
        if found[2] is None:
            return Objective(found[1])
        number = float(found[2])
        if not 0.0 < number < 1e12:
            raise ValueError
        return Objective(found[1], seconds=number) if found[3] == "s" else Objective(found[1], steps=int(number))
    except ValueError:
        raise UsageError(
            f"--objective '{text}' is not one",
            hint="return, success, length, reward_terms.NAME or terminations.NAME; @30s after 30 s of training, @2e6"
            " after so many steps",
        ) from None


def nested(overrides: Sequence[str], whole: Callable[[Path], Any] = lambda _: None) -> dict[str, Any]:
    """Overrides as the mapping that a `--config` file holds.

    Args:
        overrides: as on a command line.
        whole: the value of a path in the configuration with these overrides; a `--config` file replaces a list as a
            whole, also where only one of its elements was changed.
    """
    data: dict[Any, Any] = {}
    for text in overrides:
        path, value = parse_override(text)
        end = next((end for end in range(1, len(path)) if isinstance(whole(path[:end]), list)), len(path))
        if end < len(path):
            path, value = path[:end], whole(path[:end])
        inner = data
        for key in path[:-1]:
            inner = inner.setdefault(key, {})
        inner[path[-1]] = value
    return data


def _read(text: str) -> Parameter:
    key, equals, ranges = text.partition("=")
    key = key.strip()
    if not equals or not key or not ranges.strip():
        raise UsageError(f"--param '{text}' says no range", hint=HINT)
    try:
        parse_override(f"{key}=0")
    except ConfigError as error:
        raise UsageError(f"--param '{text}': {error.problems[0].message}", hint=HINT) from None
    span = _RANGE.fullmatch(ranges.strip())
    if span is None:
        return _choices(text, key, ranges)
    try:
        low, high = (strict_yaml.load_value(part.strip()) for part in span.groups()[1:])
    except YamlError as error:
        raise UsageError(f"--param '{text}': {error.message}", hint=HINT) from None
    log = span[1] is not None
    if any(type(end) not in (int, float) or not abs(end) < _LARGEST[type(end)] for end in (low, high)):
        raise UsageError(f"--param '{text}': the ends of a range are numbers, not beyond all bounds", hint=HINT)
    if not low < high:
        raise UsageError(f"--param '{text}' is empty: {low} is not below {high}", hint=HINT)
    if log and low <= 0:
        raise UsageError(f"--param '{text}': a logarithmic range begins above 0", hint=HINT)
    if float in (type(low), type(high)):
        low, high = float(low), float(high)
    return Parameter(key, low, high, log)


def _choices(text: str, key: str, words: str) -> Parameter:
    try:
        choices = strict_yaml.load_value(f"[{words}]")
    except YamlError as error:
        raise UsageError(f"--param '{text}': {error.message}", hint=HINT) from None
    if not isinstance(choices, list) or len(choices) < 2:
        raise UsageError(f"--param '{text}' leaves nothing to choose", hint=HINT)
    written = [_written(choice) for choice in choices]
    if len(set(written)) < len(written):
        raise UsageError(f"--param '{text}' names a choice twice")
    return Parameter(key, choices=tuple(choices))


def _written(value: Any) -> str:
    """A value in YAML, on one line."""
    from rlcli.config.dump import to_yaml

    text = to_yaml({"v": value})
    if isinstance(value, list | dict) or "\n" in text.strip():
        import json

        return json.dumps(value)  # JSON is YAML
    return text.strip().removeprefix("v:").strip()

"""Matching of names and regular expressions against the names of a model, in the order of the configuration."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import TypeVar

from rlcli.errors import did_you_mean, listing

Value = TypeVar("Value")


class NameProblem(ValueError):
    """A name or regular expression that does not fit the model; `hint` lists the names that exist."""

    def __init__(self, message: str, hint: str | None = None) -> None:
        super().__init__(message)
        self.hint = hint


class SceneProblem(NameProblem):
    """A part of the scene's configuration that does not fit the models; `path` is its key in the YAML."""

    def __init__(self, path: tuple[str, ...], message: str, hint: str | None = None) -> None:
        super().__init__(message, hint)
        self.path = path


def match(patterns: str | Sequence[str], names: Sequence[str], what: str) -> list[int]:
    """Return the positions of the names that the patterns match in full.

    Positions are in the order of the patterns; the matches of one regular expression are in the order of `names`.

    Args:
        patterns: names or regular expressions.
        names: names of the model.
        what: the kind of element, for messages: joint, body, ...

    Raises:
        NameProblem: if a pattern matches no name or is no regular expression, or if a name is matched twice.
    """
    positions: list[int] = []
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        found = [names.index(pattern)] if pattern in names else _search(pattern, names, what)
        for position in found:
            if position in positions:
                message = f"{what} '{names[position]}' is matched twice; narrow the second pattern, '{pattern}'"
                raise NameProblem(message)
            positions.append(position)
    return positions


def match_values(values: Mapping[str, Value], names: Sequence[str], what: str) -> list[Value | None]:
    """Return the value of each name in a mapping from names or regular expressions; None for a name without a match.

    Raises:
        NameProblem: under the conditions of `match`.
    """
    found: list[Value | None] = [None] * len(names)
    owner: dict[int, str] = {}
    for pattern, value in values.items():
        for position in match(pattern, names, what):
            if position in owner:
                raise NameProblem(
                    f"'{owner[position]}' and '{pattern}' both match {what} '{names[position]}'; narrow one of them"
                )
            owner[position] = pattern
            found[position] = value
    return found


def _search(pattern: str, names: Sequence[str], what: str) -> list[int]:
    try:
        regex = re.compile(pattern)
    except re.error as error:
        raise NameProblem(f"'{pattern}' is neither a {what} nor a regular expression ({error}); correct it") from None
    found = [position for position, name in enumerate(names) if regex.fullmatch(name)]
    if not found:
        suggestion = did_you_mean(pattern, names)
        existing = f"{'bodies' if what == 'body' else f'{what}s'}: {listing(names)}"
        raise NameProblem(f"no {what} matches '{pattern}'", f"{suggestion} {existing}" if suggestion else existing)
    return found

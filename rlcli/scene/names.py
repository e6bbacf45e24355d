"""Find the elements of a model (joints, bodies, ...) whose names match a name or a regular expression.

Regular expressions that could take long are refused, because they may come from an untrusted task.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

from rlcli.errors import did_you_mean, listing

Value = TypeVar("Value")

_MAX_PATTERN = 1_000
"""Largest length of a regular expression [characters]."""
_MAX_STEPS = 1e7
"""Largest estimated number of steps in which a regular expression may be compared with one name; about a second."""
_TOKEN = re.compile(
    r"\\.|\[\^?\]?(?:\\.|[^\]\\])*\]|\{\d+(?:,\d*)?\}|\{,\d+\}|\((?:\?(?:P?<\w+>|P=\w+|[a-zA-Z-]*:|<?[=!]|>|[a-z]+))?|.",
    re.DOTALL,
)
"""Pattern of a token in a regular expression: escape, set, count in braces, group start, or character."""


class NameProblem(ValueError):
    """Error for a name or regular expression that does not fit the model; `hint` says what to do."""

    def __init__(self, message: str, hint: str | None = None) -> None:
        super().__init__(message)
        self.hint = hint


class SceneProblem(NameProblem):
    """Error for a part of the scene's configuration that does not fit the models; `path` is the key in the YAML."""

    def __init__(self, path: tuple[str, ...], message: str, hint: str | None = None) -> None:
        super().__init__(message, hint)
        self.path = path


def match(patterns: str | Sequence[str], names: Sequence[str], what: str) -> list[int]:
    """Return the indices of the names that equal a pattern, or that a pattern matches completely.

    The indices are in the order of the patterns; matches of one regular expression are in the order of `names`.

    Args:
        patterns: names or regular expressions.
        names: names of the model.
        what: the kind of element, for messages: joint, body, ...

    Raises:
        NameProblem: if a pattern matches no name or is not a regular expression, or if a name is matched twice.
    """
    positions: list[int] = []
    for pattern in [patterns] if isinstance(patterns, str) else patterns:
        found = [names.index(pattern)] if pattern in names else _search_any(pattern, names, what)
        for position in found:
            if position in positions:
                message = f"{what} '{names[position]}' is matched twice; narrow the second pattern, '{pattern}'"
                raise NameProblem(message)
            positions.append(position)
    return positions


def match_values(values: Mapping[str, Value], names: Sequence[str], what: str) -> list[Value | None]:
    """Return the value of each of the names from a mapping; None for a name that no key of the mapping matches.

    Args:
        values: name or regular expression -> value.
        names: names of the model.
        what: the kind of element, for messages: joint, body, ...

    Raises:
        NameProblem: if a key matches no name or is not a regular expression, or if two keys match the same name.
    """
    found: list[Value | None] = [None] * len(names)
    owner: dict[int, str] = {}
    for pattern, value in values.items():
        for position in match(pattern, names, what):
            if position in owner:
                raise NameProblem(
                    f"'{owner[position]}' and '{pattern}' both match {what} '{names[position]}'; narrow one pattern"
                )
            owner[position] = pattern
            found[position] = value
    return found


def search(pattern: str, names: Sequence[str], what: str) -> list[int]:
    """Return the indices of the names that a regular expression matches completely.

    Raises:
        NameProblem: if the text is not a regular expression, or one that may take longer than a second.
    """
    _require_cheap(pattern, max(map(len, names), default=0))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # Python warns about `[` within a set
            regex = re.compile(pattern)
    except (re.error, OverflowError, RecursionError, FutureWarning) as error:
        message = f"'{pattern}' is neither the name of a {what} nor a regular expression ({error}); correct the text"
        raise NameProblem(message) from None
    return [position for position, name in enumerate(names) if regex.fullmatch(name)]


def _search_any(pattern: str, names: Sequence[str], what: str) -> list[int]:
    found = search(pattern, names, what)
    if not found:
        suggestion = did_you_mean(pattern, names)
        existing = f"{'bodies' if what == 'body' else f'{what}s'}: {listing(names)}"
        raise NameProblem(f"no {what} matches '{pattern}'", f"{suggestion} {existing}" if suggestion else existing)
    return found


@dataclass(slots=True)
class _Part:
    """Quantifiers counted so far in a regular expression, or in one group of it, which is read from left to right."""

    repeats: int = 0
    """Number of quantifiers * + {m,n} in the present alternative."""
    options: int = 0
    """Number of quantifiers ? in the present alternative."""
    varies: bool = False
    """Whether the part can match texts of several lengths, or has alternatives."""
    last_varies: bool = False
    """Whether the last element of the pattern, such as `a*`, can match texts of different lengths."""
    _most: tuple[int, int] = (0, 0)

    def most(self) -> tuple[int, int]:
        """Return the largest `repeats` and the largest `options` of all alternatives (separated by `|`) so far."""
        return max(self._most[0], self.repeats), max(self._most[1], self.options)

    def next_alternative(self) -> None:
        """Start the counts for the next alternative of the pattern, after a `|`."""
        self._most = self.most()
        self.repeats = self.options = 0
        self.varies, self.last_varies = True, False


def _require_cheap(pattern: str, length: int) -> None:
    """Check that a regular expression can be compared with a name of `length` characters in less than a second.

    Python's `re` tries all ways in which k repetitions can share the characters of a name: binomial(length + k, k). If
    a repeated part is variable itself, the number grows exponentially with the length.

    Raises:
        NameProblem: if the pattern is too long or too costly.
    """
    if len(pattern) > _MAX_PATTERN:
        raise NameProblem(f"a pattern has {len(pattern):,} characters; at most {_MAX_PATTERN:,} are allowed")
    parts = [_Part()]
    for token in _TOKEN.findall(pattern):
        part = parts[-1]
        if token[0] == "(":
            parts.append(_Part())
        elif token == ")" and len(parts) > 1:
            inner = parts.pop()
            repeats, options = inner.most()
            parts[-1].repeats += repeats
            parts[-1].options += options
            parts[-1].last_varies = inner.varies
            parts[-1].varies |= inner.varies
        elif token == "|":
            part.next_alternative()
        elif token == "?":
            part.options, part.varies = part.options + 1, True
        elif token in "*+" or (token[0] == "{" and len(token) > 1):
            if part.last_varies:
                raise NameProblem(
                    f"the pattern '{pattern}' repeats a group that itself contains * + ? {{m,n}} or |, as in (a*)* or"
                    " (a|b)*, which can take exponential time; repeat only groups without them, for example"
                    " [ab]* for (a|b)* and a* for (a*)*"
                )
            if token in "*+" or "," in token:
                part.repeats, part.varies, part.last_varies = part.repeats + 1, True, True
        else:
            part.last_varies = False
    repeats, options = parts[0].most()
    if min(math.comb(length + repeats, repeats), 10**9) * 2.0 ** min(options, 100) > _MAX_STEPS:
        raise NameProblem(
            f"the pattern '{pattern}' has {repeats + options} of the quantifiers * + ? {{m,n}}, which can take more"
            " than a second; use fewer quantifiers"
        )

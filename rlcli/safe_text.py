"""Helpers for text from files and command lines: find unsafe characters, shorten long text, read numbers."""

import math
import re
from collections.abc import Iterable
from pathlib import Path

UNSAFE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2028\u2029\u2066-\u2069\ud800-\udfff]")
"""Characters that must not reach a terminal: control characters except tab and newline, line separators, marks that
change the direction of text, and single surrogates."""

MAX_SEED = 2**62
"""Largest seed that a command line or a program may give."""


def shorten(value: object, limit: int, mark: str = "...") -> str:
    """Return a value as text of at most `limit` characters; `mark` replaces the part that is cut off."""
    text = str(value)
    return text if len(text) <= limit else text[: limit - len(mark)] + mark


_LONG = re.compile(r"""\S{201,}|(?<!\w)'[^']{199,}'|"[^"]{199,}\"""")
"""A word or a quoted text of over 200 characters."""
_MAX_LINE = 2000
"""Longest line of a message [characters]."""
_given: list[str] = []
"""Words of the command line that are long or have characters that are not printable, the longest first."""


def remember_given(words: Iterable[str]) -> None:
    """Store long and unprintable words of the command line and of its environment variables; messages shorten them."""
    parts = {part for word in map(str, words) for part in (word, str(Path(word)), *word.split("=", 1))}
    parts |= {part.strip() for part in parts}
    # typer escapes control characters in its messages
    parts |= {re.sub("[\x00-\x1f\x7f-\x9f]", lambda found: rf"\x{ord(found[0]):02x}", part) for part in parts}
    parts |= set(map(printable, parts))
    _given[:] = sorted((part for part in parts if len(part) > 200 or not part.isprintable()), key=len, reverse=True)


def message_line(text: str) -> str:
    """Return the text of a message on one line.

    Characters that are not printable are escaped. Words, quotes and arguments of over 200 characters are cut.
    """
    for part in _given:
        text = text.replace(part, _cut(printable(part), 200))
    return _cut(_LONG.sub(lambda found: _cut(found[0], 200), printable(text[: 10 * _MAX_LINE])), _MAX_LINE)


def printable(text: str) -> str:
    """Return a text with escapes in place of the characters that are not printable."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def _cut(text: str, limit: int) -> str:
    """Return a text without its middle, so that it has at most `limit` characters."""
    return text if len(text) <= limit else f"{text[: limit // 2]}...{text[3 - limit // 2 :]}"


_INT = re.compile(r"[-+]?(0|[1-9][0-9]{0,18})\Z")
_FLOAT = re.compile(r"(?![-+]?0[0-9]+\Z)[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]{1,4})?\Z")


def read_number(text: str) -> int | float | None:
    """Return the number that a text spells; None for any other text.

    Files and command lines have the same numbers: decimal digits without `_` and spaces, no octal numbers such as
    `010`, no words such as `inf`.
    """
    if _INT.match(text):
        return int(text)
    return float(text) if _FLOAT.match(text) else None


def float_or_nan(text: str) -> float:
    """Return the number that a text spells, with spaces around it; NaN for any other text."""
    number = read_number(text.strip())
    return math.nan if number is None else float(number)

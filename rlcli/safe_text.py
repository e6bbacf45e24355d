"""Helpers for text from files and command lines: find unsafe characters, shorten long text, read numbers."""

import math
import re

UNSAFE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""Characters that must not reach a terminal: control characters except tab and newline, marks that change the direction
of text, and single surrogates."""


def shorten(value: object, limit: int, mark: str = "...") -> str:
    """Return a value as text of at most `limit` characters; `mark` replaces the part that is cut off."""
    text = str(value)
    return text if len(text) <= limit else text[: limit - len(mark)] + mark


_LONG = re.compile(r"""\S{201,}|(?<!\w)'[^']{199,}'|"[^"]{199,}\"""")
_MAX_LINE = 2000


def message_line(text: str) -> str:
    """Return the text of a message on one line: other characters are escaped, words and quotes over 200 are cut."""
    printable = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text[: 10 * _MAX_LINE])
    return _cut(_LONG.sub(lambda found: _cut(found[0], 200), printable), _MAX_LINE)


def _cut(text: str, limit: int) -> str:
    """Return a text without its middle, so that it has at most `limit` characters."""
    return text if len(text) <= limit else f"{text[: limit // 2]}...{text[3 - limit // 2 :]}"


def float_or_nan(text: str) -> float:
    """Return the number that a text spells; NaN for any other text."""
    try:
        return float(text)
    except ValueError:
        return math.nan

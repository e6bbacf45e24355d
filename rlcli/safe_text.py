"""Helpers for text from files and command lines: find unsafe characters, shorten long text, read numbers."""

from __future__ import annotations

import math
import re

UNSAFE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""Characters that must not reach a terminal: control characters except tab and newline, marks that change the direction
of text, and single surrogates."""


def shorten(value: object, limit: int, mark: str = "...") -> str:
    """Return a value as text of at most `limit` characters; `mark` replaces the part that is cut off."""
    text = str(value)
    return text if len(text) <= limit else text[: limit - len(mark)] + mark


def float_or_nan(text: str) -> float:
    """Return the number that a text spells; NaN for any other text."""
    try:
        return float(text)
    except ValueError:
        return math.nan

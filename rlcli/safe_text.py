"""Text that comes from files: made short, and made safe to show."""

from __future__ import annotations

import re

UNSAFE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""Control characters but tab and newline, marks that turn the direction of text, and halves of surrogate pairs."""


def shorten(value: object, limit: int, mark: str = "...") -> str:
    """Return a value as text of at most `limit` characters; `mark` replaces the end that is left out."""
    text = str(value)
    return text if len(text) <= limit else text[: limit - len(mark)] + mark

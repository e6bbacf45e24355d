"""Functions for text from files and command lines: parse numbers, escape unsafe characters, keep messages short.

A message that repeats a long input would hide what is wrong. Therefore long inputs are remembered, and `message_line`
shortens copies of the inputs in messages.
"""

import math
import re
from collections import deque
from collections.abc import Iterable

UNSAFE = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2028\u2029\u2066-\u2069\ud800-\udfff]")
"""Characters that must not reach a terminal: control characters except tab and newline, line separators, marks that
change the direction of text, and single surrogates."""

MAX_SEED = 2**62
"""Largest seed that the command line and the Python API accept."""


def shorten(value: object, limit: int, mark: str = "...") -> str:
    """Return a value as text of at most `limit` characters; if text is cut off at the end, `mark` is put there."""
    text = str(value)
    return text if len(text) <= limit else text[: limit - len(mark)] + mark


_LONG = re.compile(r"""\S{201,}|(?<!\w)'[^']{199,}'|"[^"]{199,}\"""")
"""Pattern of a word or a quoted text of over 200 characters."""
_MAX_ECHO, _MAX_LINE = 200, 2000
"""Largest part of an input that a message repeats, and largest length of a line of a message [characters]."""
_inputs: deque[str] = deque(maxlen=1000)
"""Inputs (words of the command line, texts of files) whose printed form is longer than `_MAX_ECHO`."""
_input_pieces: set[int] = set()
"""Hashes of all substrings of `_inputs` with `_MAX_ECHO` + 1 characters; computed at the first long message."""


def remember_given(words: Iterable[str]) -> None:
    """Forget all inputs, then remember the long words of a command line and of its environment variables."""
    _inputs.clear()
    remember_input(words)


def remember_input(texts: Iterable[str]) -> None:
    """Remember the long texts of a command line or a file, so that `message_line` shortens them in messages."""
    _input_pieces.clear()
    for text in texts:
        if len(text) > _MAX_ECHO or not text.isprintable():
            # typer escapes control characters and some quotes in its messages
            typer_form = re.sub("[\x00-\x1f\x7f-\x9f]", lambda found: rf"\x{ord(found[0]):02x}", text)
            forms = {
                printable(text),
                printable(typer_form),
                printable(typer_form).replace("'", r"\'"),
                repr(text)[1:-1],
            }
            _inputs.extend(form for form in forms if len(form) > _MAX_ECHO)


def message_line(text: str) -> str:
    """Return the text of a message on one line of at most 2000 characters.

    Characters that are not printable are escaped. Words, quoted texts and copies of inputs of over 200 characters are
    shortened.
    """
    line = _without_echoes(printable(text[: 10 * _MAX_LINE]))
    return _cut(_LONG.sub(lambda found: _cut(found[0], _MAX_ECHO), line), _MAX_LINE)


def _without_echoes(line: str) -> str:
    """Return a line in which each copy of more than `_MAX_ECHO` consecutive characters of an input is shortened."""
    size = _MAX_ECHO + 1
    if len(line) < size or not _inputs:
        return line
    if not _input_pieces:
        _input_pieces.update(hash(text[at : at + size]) for text in _inputs for at in range(len(text) - _MAX_ECHO))
    at = 0
    while at + size <= len(line):
        end = at + size
        if hash(line[at:end]) in _input_pieces:
            while end < len(line) and hash(line[end + 1 - size : end + 1]) in _input_pieces:
                end += 1
            line = line[:at] + _cut(line[at:end], _MAX_ECHO) + line[end:]
            at += _MAX_ECHO
        else:
            at += 1
    return line


def printable(text: str) -> str:
    """Return a text with an escape sequence in place of each character that is not printable."""
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def _cut(text: str, limit: int) -> str:
    """Return a text without its middle, so that it has at most `limit` characters."""
    return text if len(text) <= limit else f"{text[: limit // 2]}...{text[3 - limit // 2 :]}"


_INT = re.compile(r"[-+]?(0|[1-9][0-9]{0,18})\Z")
_FLOAT = re.compile(r"(?![-+]?0[0-9]+\Z)[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]{1,4})?\Z")


def read_number(text: str) -> int | float | None:
    """Return the number that a text in a file or on the command line stands for; None for any other text.

    A number has decimal digits without `_` and spaces. Octal numbers such as `010` and words such as `inf` are no
    numbers.
    """
    if _INT.match(text):
        return int(text)
    return float(text) if _FLOAT.match(text) else None


def float_or_nan(text: str) -> float:
    """Return the number that a text stands for (see `read_number`), without spaces around it; NaN for other text."""
    number = read_number(text.strip())
    return math.nan if number is None else float(number)

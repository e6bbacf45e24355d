"""Reader of strict YAML: scalars of YAML 1.2, the position of every value, and limits that make untrusted files safe.

The reader uses the event stream of PyYAML's pure-Python parser (the C parser crashes on deep nesting). The reader
refuses duplicate keys, anchors, tags, merge keys, a second document, and ambiguous scalars (`on`, `010`, `.nan`); the
error has the position of the mistake.
"""

import contextlib
import functools
import itertools
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import yaml
from yaml import events

from rlcli.safe_text import read_number, remember_input

MAX_BYTES = 256 * 1024
MAX_DEPTH = 32
MAX_ITEMS = 20_000
MAX_SCALAR = 16 * 1024

Path = tuple[str | int, ...]
"""Keys and list indices that lead to a value in a YAML document."""
Mark = tuple[int, int]
"""Line and column of a value in a YAML document."""

_OCTAL = re.compile(r"[-+]?0[0-9]+\Z")
_NOT_FINITE = re.compile(r"[-+]?\.(inf|nan)\Z", re.IGNORECASE)
_SURROGATE = re.compile("[\ud800-\udfff]")
_WORDS = {"yes", "no", "on", "off"}
_CONSTANTS = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}


class YamlError(ValueError):
    """Text that is not strict YAML. `line` and `column` count from 1; both are 0 if the file as a whole is refused."""

    def __init__(self, message: str, mark: Any = None, *, place: Mark = (0, 0)) -> None:
        super().__init__(message)
        self.message = message
        line, column = (mark.line + 1, mark.column + 1) if mark else place
        self.line: int = line
        self.column: int = column


@dataclass(slots=True)
class Document:
    """A parsed mapping, and the position (line, column) of every key and list item by path."""

    data: dict[str, Any]
    marks: dict[Path, Mark] = field(default_factory=dict)


def load(text: str | bytes) -> Document:
    """Parse one document whose top level is a mapping.

    Raises:
        YamlError: with the position of the first mistake.
    """
    value, marks = _parse(decode(text))
    if value is None:
        value = {}
    if not isinstance(value, dict):
        raise YamlError("the top level must be a mapping (key: value)", place=marks[()])
    return Document(value, marks)


def load_value(text: str) -> Any:
    """Parse one value, such as `1e-3`, `[1, 2]`, `{a: 1}` or `text`, like VALUE in the YAML `key: VALUE`.

    Raises:
        YamlError: with the position of the first mistake.
    """
    return _parse(decode(text))[0]


def decode(text: str | bytes) -> str:
    """Return the text of a file.

    Raises:
        YamlError: if the file is too large or not UTF-8.
    """
    if len(text) > MAX_BYTES:
        raise YamlError(f"the file is larger than {MAX_BYTES} bytes; make it smaller")
    if isinstance(text, bytes):
        try:
            text = text.decode("utf-8")
        except UnicodeDecodeError as error:
            before = error.object[: error.start].decode("utf-8")
            raise YamlError(f"not UTF-8: {error.reason}; save as UTF-8", place=_after(before)) from None
    return text.removeprefix("\ufeff")  # the byte order mark


def _after(before: str) -> Mark:
    """Return the position (line, column) of the first character after the text `before` in a file."""
    return before.count("\n") + 1, len(before) - before.rfind("\n")


def _parse(text: str) -> tuple[Any, dict[Path, Mark]]:
    """Return the parsed value of a YAML text, and the positions (line, column) of its keys and items, by path.

    Both are copies of the cached result, so the caller may change them.
    """
    value, marks = _parse_cached(text)
    return _copy(value), dict(marks)


def _copy(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _copy(item) for key, item in value.items()}
    return [_copy(item) for item in value] if isinstance(value, list) else value


@functools.lru_cache(maxsize=8)  # a command reads the same file several times: for its format, then as a task
def _parse_cached(text: str) -> tuple[Any, dict[Path, Mark]]:
    with syntax_errors(text):
        return _read(text)


@contextlib.contextmanager
def syntax_errors(text: str) -> Iterator[None]:
    """Convert PyYAML's errors that occur in the `with` block to `YamlError`s with line and column."""
    try:
        yield
    except yaml.MarkedYAMLError as error:
        raise YamlError(
            error.problem or error.context or "syntax error", error.problem_mark or error.context_mark
        ) from None
    except yaml.reader.ReaderError as error:
        found = f"the character {chr(error.character)!r} is not allowed"
        raise YamlError(found, place=_after(text[: error.position])) from None


class Loader(yaml.SafeLoader):  # type: ignore[misc]
    """PyYAML's safe loader; it reports an invalid escape sequence in a string as an error with its position."""

    def fetch_more_tokens(self) -> Any:
        """Read the next tokens of the text."""
        try:
            return super().fetch_more_tokens()
        except (ValueError, OverflowError):  # an escape such as "\\U00110000"
            message = "an escape (\\x, \\u or \\U) is not a Unicode character; correct it"
            raise yaml.MarkedYAMLError(problem=message, problem_mark=self.get_mark()) from None


def _events(text: str) -> Iterator[events.Event]:
    """Yield PyYAML's parsing events of a text."""
    loader = Loader(text)
    try:
        while loader.check_event():
            yield loader.get_event()
    finally:
        loader.dispose()


def _checked_events(text: str) -> Iterator[events.Event]:
    """Yield PyYAML's parsing events; raise YamlError for long files, further documents, anchors, aliases and tags."""
    documents = 0
    for count, event in enumerate(_events(text)):
        if count > MAX_ITEMS:
            raise YamlError(f"the file has more than {MAX_ITEMS} items; make it smaller", event.start_mark)
        if getattr(event, "anchor", None):
            raise YamlError("anchors and aliases are not allowed; write the value again", event.start_mark)
        if getattr(event, "tag", None) not in (None, "!"):
            tag = str(event.tag).replace("tag:yaml.org,2002:", "!!")[:60]  # as the file has it
            raise YamlError(f"tags are not allowed; remove {tag}", event.start_mark)
        documents += isinstance(event, events.DocumentStartEvent)
        if documents > 1:
            raise YamlError("only one document per file is allowed; remove the line `---`", event.start_mark)
        yield event


def _read(text: str) -> tuple[Any, dict[Path, Mark]]:
    """Return the parsed value of a YAML text, and the position (line, column) of every key and list item, by path."""
    reader = _Reader(_checked_events(text))
    root = [reader.value(event, ()) for event in reader.stream if isinstance(event, events.NodeEvent)]
    return root[0] if root else None, reader.marks


@dataclass(slots=True)
class _Reader:
    """Builder of Python values from PyYAML's events; `marks` collects the position of every key and list item."""

    stream: Iterator[events.Event]
    marks: dict[Path, Mark] = field(default_factory=dict)

    def value(self, event: events.Event, path: Path) -> Any:
        """Return the value that starts with an event, and read its further events from `stream`.

        Args:
            event: first event of the value.
            path: keys and list indices that lead to the value.
        """
        self.marks.setdefault(path, _position(event))  # `_mapping` has stored the position of the key
        if isinstance(event, events.ScalarEvent):
            return _scalar(event, key=False)
        if len(path) >= MAX_DEPTH:
            raise YamlError(f"values are nested deeper than {MAX_DEPTH} levels; use fewer levels", event.start_mark)
        if isinstance(event, events.MappingStartEvent):
            return self._mapping(path)
        return [self.value(item, (*path, index)) for index, item in enumerate(self._until(events.SequenceEndEvent))]

    def _mapping(self, path: Path) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for event in self._until(events.MappingEndEvent):
            if not isinstance(event, events.ScalarEvent):
                raise YamlError("a key must be text, not a list or mapping; write `name: value`", event.start_mark)
            key = _scalar(event, key=True)
            if not isinstance(key, str):
                raise YamlError(f"keys must be text, found {key!r}; write the key in quotes", event.start_mark)
            below = (*path, key)
            if key in found:
                first = self.marks[below][0]
                raise YamlError(f"duplicate key '{key}' (first on line {first}); remove one", event.start_mark)
            self.marks[below] = _position(event)
            found[key] = self.value(next(self.stream), below)
        return found

    def _until(self, end: type[events.Event]) -> Iterator[events.Event]:
        """Yield the first event of each key or item of a mapping or list, up to its end event.

        The caller must read the further events of each value before it takes the next one.
        """
        return itertools.takewhile(lambda event: not isinstance(event, end), self.stream)


def _position(event: events.Event) -> Mark:
    return event.start_mark.line + 1, event.start_mark.column + 1


def check_scalar(event: events.ScalarEvent) -> str:
    """Return the text of a scalar.

    Raises:
        YamlError: if the text has more than `MAX_SCALAR` characters, or half of a surrogate pair.
    """
    text: str = event.value
    if len(text) > MAX_SCALAR:
        raise YamlError(f"the value is longer than {MAX_SCALAR} characters; shorten it", event.start_mark)
    if _SURROGATE.search(text):
        raise YamlError("half of a surrogate pair (\\ud800 to \\udfff) is not a character; remove it", event.start_mark)
    remember_input([text])
    return text


def _scalar(event: events.ScalarEvent, *, key: bool) -> Any:
    """Return the value of a scalar by the rules of YAML 1.2.

    Args:
        event: the scalar.
        key: whether the scalar is a key of a mapping.

    Raises:
        YamlError: for a scalar that parsers of YAML 1.1 read differently, such as `on` or `010`.
    """
    text = check_scalar(event)
    if not event.implicit[0]:  # quoted or block: always text
        return text
    if key and text == "<<":
        raise YamlError("merge keys (<<) are not allowed; copy the keys and values", event.start_mark)
    if text in _CONSTANTS:
        return _CONSTANTS[text]
    if _OCTAL.match(text):
        message = f"{text} is ambiguous (octal in YAML 1.1); remove the leading 0, or write the value in quotes"
        raise YamlError(message, event.start_mark)
    if (number := read_number(text)) is not None:
        if math.isinf(number):
            raise YamlError(f"the number {text[:20]} is out of range; allowed: up to 1.8e308", event.start_mark)
        return number
    if _NOT_FINITE.match(text):
        raise YamlError(f"{text} is not allowed; write a number, or null for none", event.start_mark)
    if text.lower() in _WORDS:  # y and n are allowed, because x, y and z are names of parameters
        raise YamlError(f"{text} is ambiguous; write true or false, or quote the text", event.start_mark)
    return text

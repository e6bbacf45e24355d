"""Everything that is printed: data on stdout, messages on stderr, one JSON document with `--json`."""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rlcli.cli.ui.terminal import supports_styles
from rlcli.safe_text import UNSAFE

if TYPE_CHECKING:
    from rlcli.reporting.heat_map import HeatMap

SCHEMA_VERSION = 1
_OWN = ("bug", "device", "diverged")
"""Kinds of errors that one process of several may have alone."""
_GONE = (errno.EPIPE, errno.EIO)
"""Errors of writing to a pipe without a reader, and to a terminal that was closed."""


@dataclass(slots=True)
class Console:
    """Output of one command: data, messages and the JSON document, as its flags ask for them."""

    json: bool = False
    quiet: bool = False
    verbose: bool = False
    debug: bool = False
    follows: bool = False
    """Another process of the run prints; this one prints nothing but its own errors."""

    owns_process: bool = False
    """Whether the process was started for this command and ends with it."""

    has_document: bool = False
    """Whether the JSON document is printed: what ends the command after that, such as Ctrl-C, prints no second one."""

    out: Any = None
    """Where the JSON document goes; None is stdout."""

    @contextlib.contextmanager
    def stdout_kept(self) -> Iterator[None]:
        """With --json, what others print on stdout goes to stderr: only the document is left there."""
        if not self.json or sys.stdout is None or sys.stderr is None:
            yield
            return
        self.out = sys.stdout
        try:
            with contextlib.redirect_stdout(sys.stderr):
                yield
        finally:
            self.out = None

    def data(self, text: str) -> None:
        """The result, as text for people; left out with --json."""
        if not self.json and not self.follows:
            _write(sys.stdout, text)

    def document(self, command: str, **content: Any) -> None:
        """The result, as JSON; left out without --json."""
        if self.json and not self.follows:
            self.has_document = True
            _write(
                self.out or sys.stdout,
                json.dumps({"schema": SCHEMA_VERSION, "command": command, **content}, indent=2, default=str),
            )

    def info(self, text: str) -> None:
        """A message about what is being done."""
        if not self.quiet and not self.follows:
            _write(sys.stderr, text)

    def detail(self, text: str) -> None:
        """A message for -v."""
        if self.verbose and not self.quiet and not self.follows:
            _write(sys.stderr, text)

    def warn(self, text: str) -> None:
        """Something the user should know, but that stops nothing."""
        if self.follows:
            return
        _write(sys.stderr, f"warning: {_harmless(text)}")

    def error(self, kind: str, code: int, message: str, hint: str | None, problems: list[dict[str, Any]]) -> None:
        """Why the command failed."""
        if self.follows and kind not in _OWN:
            return
        if self.json and not self.follows and not self.has_document:
            error = {"kind": kind, "exit_code": code, "message": message, "hint": hint, "problems": problems}
            with contextlib.suppress(OSError):  # stdout may be what failed
                _write(self.out or sys.stdout, json.dumps({"schema": SCHEMA_VERSION, "error": error}, indent=2))
        lines = message.splitlines() or [""]
        _write(sys.stderr, "\n".join(f"error: {_harmless(line)}" for line in lines))
        if hint:
            _write(sys.stderr, f"hint: {_harmless(hint)}")

    def table(self, columns: list[str], rows: list[list[str]], title: str | None = None) -> None:
        """A table on stdout: plain columns, or what fits on a terminal."""
        if self.json:
            return
        if supports_styles(sys.stdout):
            from rlcli.cli.ui.tables import draw_table

            draw_table([*map(plain, columns)], [[*map(plain, row)] for row in rows], title and plain(title))
            return
        widths = [max(len(cell) for cell in column) for column in zip(columns, *rows, strict=True)]
        for row in [columns, *rows]:
            cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
            _write(sys.stdout, "  ".join(cells).rstrip())

    def heat_map(self, title: str, corner: str, heat_map: HeatMap) -> None:
        """Print a map of numbers on stdout, in colours where stdout is a terminal: red is low, green is high."""
        cells = zip(heat_map.rows.values, heat_map.cells, strict=True)
        rows = [[name, *(f"{number:.2f}" for number in numbers)] for name, numbers in cells]
        if self.json or not supports_styles(sys.stdout):
            self.data(title)
            self.table([corner, *heat_map.columns.values], rows)
            return
        from rlcli.cli.ui.tables import draw_map

        styles = [[_shade(heat_map.share(number)) for number in numbers] for numbers in heat_map.cells]
        heading = [plain(title) + ":", plain(corner)]
        draw_map(heading, [*map(plain, heat_map.columns.values)], [[*map(plain, row)] for row in rows], styles)


def _shade(share: float) -> str:
    """Black on red at 0, yellow at a half, green at 1."""
    red, green = min(1.0, 2.0 - 2.0 * share), min(1.0, 2.0 * share)
    return f"#000000 on #{round(225 * red):02x}{round(200 * green):02x}40"


console = Console()


class _ConsoleHandler(logging.Handler):
    """Handler that prints the records of the logger `rlcli`: warnings always, INFO unless -q, DEBUG with -v."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one record on stderr."""
        if record.levelno >= logging.WARNING:
            console.warn(record.getMessage())
        elif record.levelno >= logging.INFO:
            console.info(record.getMessage())
        else:
            console.detail(record.getMessage())


def print_log_records() -> None:
    """Send the records of the logger `rlcli` to the console; repeated calls add nothing."""
    logger = logging.getLogger("rlcli")
    if not any(isinstance(handler, _ConsoleHandler) for handler in logger.handlers):
        logger.addHandler(_ConsoleHandler())
        logger.setLevel(logging.DEBUG)


def plain(text: str) -> str:
    """Return text without control characters: text of an untrusted file may not steer the terminal."""
    return UNSAFE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def discard(stream: Any) -> None:
    """Write nothing more to a stream that cannot be written, at exit either."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _harmless(text: str) -> str:
    """Text that may come from an untrusted file, with escapes for the characters that are not printable."""
    return "".join(c if c.isprintable() or c in "\n\t" else repr(c)[1:-1] for c in text)


def _write(stream: Any, text: str) -> None:
    if stream is None:  # closed by the parent process
        return
    text = plain(text)
    try:
        print(text, file=stream, flush=True)
    except OSError as error:
        if error.errno not in _GONE and stream is not sys.stderr:
            raise
        discard(stream)  # the reader is gone, or a log is full; the command goes on
    except UnicodeEncodeError:
        print(text.encode(stream.encoding, "backslashreplace").decode(stream.encoding), file=stream, flush=True)

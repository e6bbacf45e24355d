"""Everything that is printed: data on stdout, messages on stderr, one JSON document with `--json`."""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from rlcli.config.settings import setting

SCHEMA_VERSION = 1
_OWN = ("bug", "device", "diverged")
"""Kinds of errors that one process of several may have alone."""
_GONE = (errno.EPIPE, errno.EIO)
"""Nobody reads the pipe any more; the terminal was closed."""


@dataclass(slots=True)
class Console:
    """How much to say, and whether to say it as JSON."""

    json: bool = False
    quiet: bool = False
    verbose: bool = False
    debug: bool = False
    follows: bool = False
    """Another process of the same run says what there is to say; only what is wrong with this one is said here."""

    owns_process: bool = False
    """Whether the process was started for the command and ends with it."""

    told: bool = False
    """Whether the command has said its document: what ends it after that, such as Ctrl-C, brings no second one."""

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
            self.told = True
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
        if self.json and not self.follows and not self.told:
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
        if drawable(sys.stdout):
            from rlcli.cli.tables import draw_table

            draw_table([*map(plain, columns)], [[*map(plain, row)] for row in rows], title and plain(title))
            return
        widths = [max(len(cell) for cell in column) for column in zip(columns, *rows, strict=True)]
        for row in [columns, *rows]:
            cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
            _write(sys.stdout, "  ".join(cells).rstrip())

    def heat_map(self, title: str, corner: str, drawn: Any) -> None:
        """A map of numbers on stdout, in colours where stdout is a terminal: red is low, green high.

        `drawn` has `rows`, `columns`, `cells` and `share(number)`, the place of a number on the scale from 0 to 1.
        """
        rows = [[name, *(f"{x:.2f}" for x in cells)] for name, cells in zip(drawn.rows, drawn.cells, strict=True)]
        if self.json or not drawable(sys.stdout):
            self.data(title)
            self.table([corner, *drawn.columns], rows)
            return
        from rlcli.cli.tables import draw_map

        styles = [[_shade(drawn.share(x)) for x in cells] for cells in drawn.cells]
        heading = [plain(title) + ":", plain(corner)]
        draw_map(heading, [*map(plain, drawn.columns)], [[*map(plain, row)] for row in rows], styles)


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


def is_terminal(stream: Any) -> bool:
    """Whether a stream is a terminal that knows how to move its cursor."""
    return stream is not None and stream.isatty() and os.environ.get("TERM") not in ("dumb", "unknown")


def drawable(stream: Any) -> bool:
    """Whether tables with styles belong on a stream: a terminal, or one that colours are forced on."""
    return stream is not None and (stream.isatty() or colors() == "always")


def colors() -> str:
    """never, always or auto (on a terminal): as NO_COLOR or else FORCE_COLOR say if they are not empty, or settings."""
    if os.environ.get("NO_COLOR"):
        return "never"
    if os.environ.get("FORCE_COLOR"):
        return "always"
    return str(setting("color") or "auto")


_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff]")
"""What a terminal would obey, what turns the direction of text, and halves of characters; not tab and newline."""


def plain(text: str) -> str:
    """Text as it can be shown: what stands in a stranger's file may not steer the terminal."""
    return _CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def discard(stream: Any) -> None:
    """Write nothing more to a stream that cannot be written, at exit either."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _harmless(text: str) -> str:
    """What a stranger's file may have said, without the characters that command a terminal."""
    return "".join(c if c.isprintable() or c in "\n\t" else repr(c)[1:-1] for c in text)


def _write(stream: Any, text: str) -> None:
    if stream is None:  # closed by whoever started us
        return
    text = plain(text)
    try:
        print(text, file=stream, flush=True)
    except OSError as error:
        if error.errno not in _GONE and stream is not sys.stderr:
            raise
        discard(stream)  # whoever read it is gone, or a log is full; what we do may still matter
    except UnicodeEncodeError:
        print(text.encode(stream.encoding, "backslashreplace").decode(stream.encoding), file=stream, flush=True)

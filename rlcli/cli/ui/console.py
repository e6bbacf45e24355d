"""Writer for the output of all commands: data on stdout, messages on stderr, one JSON document with --json.

The writer escapes control characters in texts, because texts may come from untrusted files.
"""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import re
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from rlcli.cli.ui.terminal import supports_styles
from rlcli.errors import ConfigError, MachineError, RlcliError
from rlcli.safe_text import UNSAFE, message_line

if TYPE_CHECKING:
    from rlcli.reporting.heat_map import HeatMap

SCHEMA_VERSION = 1
_ERRORS_OF_ONE_RANK = ("bug", "device", "diverged")
"""Kinds of errors (`RlcliError.kind`) that every rank prints, because they may happen on one rank only."""
_ESCAPED = re.compile(f"{UNSAFE.pattern}|[\t\n]")
_NO_READER = (errno.EPIPE, errno.EIO)
"""Error numbers of a failed write because the pipe has no reader or the terminal was closed."""


@dataclass(slots=True)
class Console:
    """Writer for the output of a command: result, messages and JSON document. --json, -q and -v set what is printed."""

    json: bool = False
    quiet: bool = False
    verbose: bool = False
    debug: bool = False
    muted: bool = False
    """Whether this process is a rank other than 0, which prints only its own errors: rank 0 prints the rest."""
    owns_process: bool = False
    """Whether this process runs only this command; False if Python code has called `main(arguments)`."""
    has_document: bool = False
    """Whether the JSON document is printed; an error after that, such as Ctrl-C, prints no second document."""
    has_line: bool = False
    """Whether the last line of the terminal shows progress; further output first erases this line."""
    out: Any = None
    """Stream to which the JSON document is written; None means stdout."""

    @contextlib.contextmanager
    def stdout_kept(self) -> Iterator[None]:
        """With --json, redirect what libraries print on stdout to stderr, so that stdout has only the document."""
        if not self.json or sys.stdout is None or sys.stderr is None:
            yield
            return
        self.out = sys.stdout
        try:
            with contextlib.redirect_stdout(sys.stderr):
                yield
        finally:
            self.out = None

    def clear_line(self) -> None:
        """Erase the last line of the terminal if it shows progress (`has_line`)."""
        if self.has_line and sys.stderr is not None:
            self.has_line = False
            with contextlib.suppress(OSError, ValueError):  # the terminal may be closed
                sys.stderr.write("\r\x1b[K")
                sys.stderr.flush()

    def data(self, *lines: str) -> None:
        """Print lines of the result; newlines in a line are escaped. With --json print nothing."""
        if not self.json and not self.muted:
            _write(sys.stdout, *lines)

    def document(self, command: str, **content: Any) -> None:
        """Print the result as one JSON object; without --json print nothing.

        Args:
            command: name of the command, the value of the key `command`.
            content: further keys and values of the object.
        """
        if self.json and not self.muted:
            self.has_document = True
            self._write_json(command=command, **content)

    def info(self, text: str) -> None:
        """Print a message about progress, unless -q is set."""
        if not self.quiet and not self.muted:
            _write(sys.stderr, message_line(text))

    def detail(self, text: str) -> None:
        """Print a detailed message, only if -v is set."""
        if self.verbose and not self.quiet and not self.muted:
            _write(sys.stderr, message_line(text))

    def warn(self, text: str) -> None:
        """Print a non-fatal warning."""
        if not self.muted:
            _write(sys.stderr, f"warning: {message_line(text)}")

    def error(self, error: RlcliError) -> None:
        """Print the error that ended the command."""
        if self.muted and error.kind not in _ERRORS_OF_ONE_RANK:
            return
        if self.json and not self.muted and not self.has_document:
            problems = [asdict(problem) for problem in error.problems] if isinstance(error, ConfigError) else []
            content = {"kind": error.kind, "exit_code": error.exit_code, "message": error.message, "hint": error.hint}
            with contextlib.suppress(MachineError):  # stdout itself may be broken
                self._write_json(error={**content, "problems": problems})
        _write(sys.stderr, *(f"error: {line}" for line in error.message.split("\n")))
        if error.hint:
            _write(sys.stderr, f"hint: {error.hint}")

    def _write_json(self, **content: Any) -> None:
        text = json.dumps({"schema": SCHEMA_VERSION, **content}, indent=2, default=str)
        _write(self.out or sys.stdout, *text.split("\n"))

    def table(self, columns: list[str], rows: list[list[str]], title: str | None = None) -> None:
        """Print a table on stdout: padded columns in a pipe, a table that fits the width on a terminal."""
        if self.json:
            return
        columns, rows = [*map(plain, columns)], [[*map(plain, row)] for row in rows]
        if supports_styles(sys.stdout):
            from rlcli.cli.ui.tables import draw_table

            draw_table(columns, rows, title and plain(title))
            return
        widths = [max(len(cell) for cell in column) for column in zip(columns, *rows, strict=True)]
        for row in [columns, *rows]:
            cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
            _write(sys.stdout, "  ".join(cells).rstrip())

    def heat_map(self, title: str, corner: str, heat_map: HeatMap) -> None:
        """Print a heat map on stdout, on a terminal in colours: red is low, green is high.

        Args:
            title: the metric and the policy.
            corner: text above the names of the rows: the two varied parameters.
            heat_map: the values.
        """
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
    """Return rich's style of a heat map's cell: black text on a colour from red over yellow to green.

    Args:
        share: position of the cell's value on the colour scale: 0 is red, 0.5 yellow, 1 green.
    """
    red, green = min(1.0, 2.0 - 2.0 * share), min(1.0, 2.0 * share)
    return f"#000000 on #{round(225 * red):02x}{round(200 * green):02x}40"


console = Console()


class _ConsoleHandler(logging.Handler):
    """Logging handler that prints warnings always, INFO unless -q is set, and DEBUG with -v."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print one log record on stderr."""
        if record.levelno >= logging.WARNING:
            console.warn(record.getMessage())
        elif record.levelno >= logging.INFO:
            console.info(record.getMessage())
        else:
            console.detail(record.getMessage())


def print_log_records() -> None:
    """Add a handler to the logger `rlcli` that prints its records; further calls have no effect."""
    logger = logging.getLogger("rlcli")
    if not any(isinstance(handler, _ConsoleHandler) for handler in logger.handlers):
        logger.addHandler(_ConsoleHandler())
        logger.setLevel(logging.DEBUG)


def plain(text: str) -> str:
    """Escape control characters and newlines: text of untrusted files cannot control the terminal or add lines."""
    return _ESCAPED.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def output_error(error: OSError) -> MachineError:
    """Return the error that stdout cannot be written, with the reason of the operating system."""
    return MachineError(f"cannot write the output: {error.strerror or error}", hint="redirect stdout to another file")


def redirect_to_null(stream: Any) -> None:
    """Redirect a broken stream to the null device: Python flushes the stream at exit, which would fail otherwise."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _write(stream: Any, *lines: str) -> None:
    """Print lines on a stream, with control characters escaped.

    Raises:
        MachineError: if stdout cannot be written, for example to a full disk.
    """
    if stream is None:  # the parent process closed stderr; without stdout no command runs
        return
    text = "\n".join(map(plain, lines))
    console.clear_line()
    try:
        print(text, file=stream, flush=True)
    except OSError as error:
        redirect_to_null(stream)  # the reader has ended, or the disk of a log is full: the command continues
        if error.errno not in _NO_READER and stream is not sys.stderr:
            raise output_error(error) from None
    except UnicodeEncodeError:
        print(text.encode(stream.encoding, "backslashreplace").decode(stream.encoding), file=stream, flush=True)

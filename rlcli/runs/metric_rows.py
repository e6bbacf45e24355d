"""Read the file `metrics.jsonl` of a run, which has one row (line) of metrics for each iteration.

The file may be untrusted, and a killed process may leave an incomplete last row.
"""

import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rlcli.errors import CheckpointError
from rlcli.runs.safe_io import read_errors

_log = logging.getLogger(__name__)
LONGEST_LINE = 2**20
"""Longest line of `metrics.jsonl`, which has the metrics of one iteration [bytes]."""
_MOST_BYTES = 2**30
_LARGEST = 1e300
"""Largest absolute value of a metric; larger numbers are ignored, because such an integer cannot become a float."""


def read_rows(file: Path, *, strict: bool = False) -> Iterator[dict[str, Any]]:
    """Yield the rows of a `metrics.jsonl` as metric -> number, the oldest first; nothing if there is no file.

    An incomplete last line, as a killed process leaves one, is skipped.

    Args:
        file: the file.
        strict: raise an error at a corrupt line; if false, log a warning, and leave out the line and all later ones.

    Raises:
        CheckpointError: if the file cannot be read or is too large, or at a corrupt line.
    """
    size = 0
    try:
        with read_errors(file), file.open("rb") as lines:
            for number, line in enumerate(iter(lambda: lines.readline(LONGEST_LINE), b""), start=1):
                size += len(line)
                if size > _MOST_BYTES:
                    raise CheckpointError(f"{file} is larger than {_MOST_BYTES:,} bytes; delete old lines")
                row = parse_row(line)
                if row is not None:
                    yield row
                elif not line.endswith(b"\n") and len(line) < LONGEST_LINE:
                    return
                elif strict:
                    raise CheckpointError(f"{file}:{number} is corrupt: not a row of metrics; delete this line")
                else:
                    _log.warning("%s:%d is not a row of metrics; the rows from there on are left out", file, number)
                    return
    except FileNotFoundError:
        return


def parse_row(line: bytes) -> dict[str, Any] | None:
    """Return the numbers in one line of the file, by metric.

    Return None if the line is not JSON with the integers `iteration` and `step`.
    """
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        return None
    row = {name: value for name, value in row.items() if is_number(value)} if isinstance(row, dict) else {}
    return row if all(type(row.get(key)) is int for key in ("iteration", "step")) else None


def is_number(value: Any) -> bool:
    """Return whether a value of untrusted JSON is a finite number; a bool is not a number."""
    return type(value) in (int, float) and -_LARGEST < value < _LARGEST

"""Read untrusted files safely, such as those of a downloaded run.

Sizes are limited, links and pipes are refused, and JSON is parsed strictly and validated with pydantic models.
"""

import contextlib
import errno
import json
import math
import os
import re
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, BinaryIO, NoReturn, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from rlcli.config import messages
from rlcli.errors import CheckpointError
from rlcli.safe_text import remember_input

JSON_LIMIT = 4 * 2**20
"""Largest JSON file [bytes]."""
_MAX_DEPTH = 32
_MAX_DIGITS = 20
_NOT_A_FILE = (errno.ELOOP, errno.ENXIO, errno.EISDIR)
"""Errors of open() for links, pipes, sockets and folders."""
_CHECK_ACCESS = "check the path, and that you may read it"
_NO_LINKS = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)

Model = TypeVar("Model", bound=BaseModel)


class FileModel(BaseModel):
    """Base of models of JSON files: wrong types and numbers that are not finite are refused, extra keys are ignored."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False)


def _require_printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("the text has a character that cannot be printed, such as a control character; remove it")
    return text


Count = Annotated[int, Field(ge=0, lt=2**62)]
PrintableText = Annotated[str, Field(max_length=4096), AfterValidator(_require_printable)]
"""Text of a JSON file with printable characters only, such as a name or a path."""


def check_json(kind: type[Model], value: object, file: Path, *keys: str, hint: str | None = None) -> Model:
    """Validate a value of a JSON file with a pydantic model, and return the model's object.

    Args:
        kind: the model's class.
        value: the parsed JSON.
        file: the file, for the message.
        keys: the keys that lead to the value in the file.
        hint: the hint of the error.

    Raises:
        CheckpointError: if the value does not fit the model; the message has the key of the first problem, the value
            found, and what is allowed.
    """
    try:
        return kind.model_validate_json(json.dumps(value))  # strict models accept a list for a tuple only in JSON
    except ValidationError as error:
        if error.errors()[0]["type"] == "json_invalid":
            path, message = (
                _find_half_character(value),
                "the text has half of a surrogate pair, which is not a character",
            )
        else:
            problem = next(messages.problems(error, kind, value, messages.dotted))
            path, message = problem.path, problem.message
        at = ".".join(filter(None, (*keys, path)))[:200]
        raise CheckpointError(f"{file} is corrupt: {at + ': ' if at else ''}{message}", hint=hint) from None


def _find_half_character(value: object, path: tuple[str | int, ...] = ()) -> str:
    r"""Return the dotted key of the first text in JSON data with half of a surrogate pair (`\ud800`); else ''."""
    if isinstance(value, str):
        return messages.dotted(path) if re.search("[\ud800-\udfff]", value) else ""
    parts = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    inner = (_find_half_character(text, (*path, key)) for key, item in parts for text in (key, item))
    return next(filter(None, inner), "")


@contextlib.contextmanager
def read_errors(file: Path) -> Iterator[None]:
    """Turn an OSError inside the `with` block into a CheckpointError that names the file.

    A FileNotFoundError is raised unchanged.
    """
    try:
        yield
    except FileNotFoundError:
        raise
    except OSError as error:
        raise CheckpointError(f"{file} cannot be read: {error.strerror or error}", hint=_CHECK_ACCESS) from None


def read_file(file: Path, limit: int, *, size: int | None = None, missing: str | None = None) -> bytes:
    """Return the content of a regular file. Callers check these bytes and never read the file again: it may change.

    Args:
        file: the file.
        limit: largest size [bytes]; a larger file is not read at all.
        size: the size that the file must have [bytes]; None: any.
        missing: message of the CheckpointError if the file does not exist; None: raise FileNotFoundError.

    Raises:
        CheckpointError: if the file is a link, not a regular file, too large or of another size, or cannot be read.
        FileNotFoundError: if the file does not exist and `missing` is None.
    """
    try:
        with _opened(file) as (opened, found):
            if size is not None and found != size:
                raise manifest_error(file, f"its size is {found} bytes, but the manifest has {size}")
            if found > limit:
                raise CheckpointError(f"{file} is too large: {found:,} bytes; at most {limit:,} are read")
            return opened.read(found)
    except FileNotFoundError:
        if missing is None:
            raise
        raise CheckpointError(missing) from None


def manifest_error(file: Path, difference: str) -> CheckpointError:
    """Return the error for a file of a checkpoint that differs from manifest.json; `difference` is what differs."""
    return CheckpointError(f"{file} is corrupt: {difference}", hint="choose an older checkpoint: RUN@step:N")


def read_tail(file: Path, limit: int) -> tuple[bytes, bool]:
    """Read the last `limit` bytes of a regular file that another process may be writing.

    Returns:
        The bytes, and whether they are the whole file.

    Raises:
        CheckpointError: if the file is a link, not a regular file, or cannot be read.
        FileNotFoundError: if the file does not exist.
    """
    with _opened(file) as (opened, size):
        begin = max(0, size - limit)
        opened.seek(begin)
        return opened.read(size - begin), begin == 0


@contextlib.contextmanager
def _opened(file: Path) -> Iterator[tuple[BinaryIO, int]]:
    """Open a regular file for a `with` block, which receives the open file and its size [bytes].

    Raises:
        CheckpointError: if the file is a link or not a regular file, or if reading in the block fails.
        FileNotFoundError: if the file does not exist.
    """
    try:
        if file.is_symlink():
            raise CheckpointError(f"{file} is a link; replace it by the file itself")
        handle = os.open(file, os.O_RDONLY | _NO_LINKS)  # O_NONBLOCK: open() must not wait for the writer of a pipe
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            os.close(handle)
            raise CheckpointError(f"{file} is not a regular file; put a regular file in its place")
        with os.fdopen(handle, "rb") as opened:
            yield opened, status.st_size
    except (FileNotFoundError, NotADirectoryError) as error:
        raise FileNotFoundError(*error.args) from None
    except (OSError, ValueError, MemoryError) as error:
        reason = getattr(error, "strerror", None) or str(error) or "there is not enough memory"
        if getattr(error, "errno", None) in _NOT_A_FILE:
            reason = "it is not a regular file"
        raise CheckpointError(f"{file} cannot be read: {reason}", hint=_CHECK_ACCESS) from None


def parse_json(data: bytes | str, file: Path) -> dict[str, Any]:
    """Parse a JSON object strictly: unique keys, finite numbers with at most 20 digits, at most 32 levels of nesting.

    Raises:
        CheckpointError: if the text is not such an object; the message names `file`.
    """
    try:
        text = data if isinstance(data, str) else data.decode()
        value = json.loads(
            text,
            object_pairs_hook=_unique_keys,
            parse_constant=_refuse_constant,
            parse_float=_finite_float,
            parse_int=_short_int,
        )
        _check_depth(value)
    except _StrictError as error:
        raise CheckpointError(f"{file} is corrupt: {error}", hint="restore the file from a backup") from None
    except (ValueError, RecursionError):
        raise CheckpointError(f"{file} is corrupt: not JSON", hint="restore the file from a backup") from None
    if not isinstance(value, dict):
        raise CheckpointError(f"{file} is corrupt: not a JSON object", hint="restore the file from a backup")
    return value


def read_json(folder: Path, name: str, limit: int = JSON_LIMIT, *, missing: str | None = None) -> dict[str, Any]:
    """Read a JSON object from a file in a folder; a link to a file outside the folder is refused.

    Args:
        folder: the folder.
        name: path of the file in the folder.
        limit: largest size [bytes].
        missing: message of the CheckpointError if the file does not exist; None: raise FileNotFoundError.

    Raises:
        CheckpointError: if the file cannot be read, or is not a JSON object.
        FileNotFoundError: if the file does not exist and `missing` is None.
    """
    file = folder / name
    with read_errors(file):
        require_inside(folder, file)
        return parse_json(read_file(file, limit, missing=missing), file)


def require_inside(folder: Path, file: Path) -> None:
    """Check that the real path of a file is inside a folder.

    Raises:
        OSError: if a link leads elsewhere.
    """
    real = Path(os.path.realpath(file))  # resolve() raises RuntimeError for a link to itself
    if not real.is_relative_to(os.path.realpath(folder)):
        raise OSError(errno.ELOOP, "it is a link out of the folder; replace it by the file itself", str(file))


def require_plain_entries(folder: Path, *, only_links: bool = False) -> None:
    """Check that a folder of a run contains only regular files and folders.

    A write through a link would change files outside the run, and opening a pipe would block.

    Args:
        folder: the folder.
        only_links: refuse only links, and accept pipes and devices, for callers whose reading does not block.

    Raises:
        CheckpointError: for the first entry that is a link, a pipe or a device.
    """
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
        links = [entry.name for entry in entries if entry.is_symlink()]
        special = [entry.name for entry in entries if not (entry.is_file() or entry.is_dir())]
    except OSError as error:
        raise CheckpointError(f"{folder} cannot be read: {error.strerror}", hint=_CHECK_ACCESS) from None
    if links:
        raise CheckpointError(f"{folder / links[0]} is a link; replace it by the file itself")
    if special and not only_links:
        raise CheckpointError(f"{folder / special[0]} is not a regular file; move it out of the run's folder")


class _StrictError(ValueError):
    """Error for JSON that Python's parser accepts and rlcli refuses, for example with a duplicate key."""


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    if len(value) != len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise _StrictError(f"key '{twice[:40]}' appears twice")
    return value


def _refuse_constant(name: str) -> NoReturn:
    raise _StrictError(f"{name} is not a JSON number")


def _finite_float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise _StrictError(f"the number {text[:20]} is too large; the largest number allowed is 1.8e308")
    return value


def _short_int(text: str) -> int:
    if len(text) > _MAX_DIGITS:
        raise _StrictError(f"a number has {len(text)} digits; at most {_MAX_DIGITS} are allowed")
    return int(text)


def _check_depth(value: object) -> None:
    level = [value]
    for _ in range(_MAX_DEPTH):
        names = [name for item in level if isinstance(item, dict) for name in item]
        remember_input([*names, *(item for item in level if isinstance(item, str))])
        level = [
            inner
            for outer in level
            if isinstance(outer, dict | list)
            for inner in (outer.values() if isinstance(outer, dict) else outer)
        ]
        if not level:
            return
    raise _StrictError(f"values are nested deeper than {_MAX_DEPTH} levels")

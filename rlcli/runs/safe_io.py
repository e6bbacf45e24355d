"""Read untrusted files: plain files of a limited size, strict JSON, and pydantic models of what the JSON may hold."""

from __future__ import annotations

import errno
import json
import math
import os
import stat
from pathlib import Path
from typing import Annotated, Any, BinaryIO, NoReturn, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from rlcli.config import messages
from rlcli.errors import CheckpointError

JSON_LIMIT = 4 * 2**20
"""Largest JSON file [bytes]."""
_DEPTH = 32
_DIGITS = 20
_NO_LINKS = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)


Model = TypeVar("Model", bound=BaseModel)


class FileModel(BaseModel):
    """Base of the models of JSON files: wrong types and numbers that are not finite are refused; extra keys are not."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False)


def _require_printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("has characters that cannot be printed")
    return text


Count = Annotated[int, Field(ge=0, lt=2**62)]
Word = Annotated[str, Field(max_length=4096), AfterValidator(_require_printable)]
"""A name or a path."""


def check_json(kind: type[Model], value: object, file: Path, *place: str, hint: str | None = None) -> Model:
    """Return a value of a JSON file as a model.

    Args:
        kind: the model.
        value: what was read; it must consist of what JSON has.
        file: the file, for the message.
        place: the keys that lead to the value in the file.
        hint: the hint of the error.

    Raises:
        CheckpointError: with the place of the first problem, what was found there, and what is allowed.
    """
    try:
        return kind.model_validate_json(json.dumps(value))  # of JSON strict models take lists for tuples
    except ValidationError as error:
        problem = messages.problems(error, kind, value, messages.dotted)[0]
        at = ".".join(filter(None, (*place, problem.path)))[:200]
        raise CheckpointError(f"{file} is corrupt: {at + ': ' if at else ''}{problem.message}", hint=hint) from None


def read_file(file: Path, limit: int, *, size: int | None = None) -> bytes:
    """The content of a plain file, read once; whatever is checked afterwards is checked on these bytes.

    Args:
        file: what to read.
        limit: largest size [bytes]; a larger file is not read at all.
        size: the size that it must have; None: any.

    Raises:
        CheckpointError: if it is a link, no plain file, too large or of another size, or cannot be read.
        FileNotFoundError: if it is not there.
    """
    handle, status = _open(file)
    with os.fdopen(handle, "rb") as opened:
        if size is not None and status.st_size != size:
            raise CheckpointError(
                f"{file} is corrupt: it is not what the manifest says ({status.st_size} bytes of {size})",
                hint="choose an older checkpoint with RUN@step:N",
            )
        if status.st_size > limit:
            raise CheckpointError(f"{file} is too large: {status.st_size:,} bytes, at most {limit:,} are read")
        return _read(opened, file, 0, status.st_size)


def read_tail(file: Path, limit: int) -> tuple[bytes, bool]:
    """The last bytes of a plain file that may be growing, and whether they are all of it.

    Raises:
        CheckpointError: if it is a link or no plain file, or cannot be read.
        FileNotFoundError: if it is not there.
    """
    handle, status = _open(file)
    begin = max(0, status.st_size - limit)
    with os.fdopen(handle, "rb") as opened:
        return _read(opened, file, begin, status.st_size - begin), begin == 0


def _read(opened: BinaryIO, file: Path, begin: int, count: int) -> bytes:
    try:
        if begin:
            opened.seek(begin)
        return opened.read(count)
    except (OSError, MemoryError) as error:
        why = getattr(error, "strerror", None) or "there is not enough memory"
        raise CheckpointError(f"{file} cannot be read: {why}") from None


def _open(file: Path) -> tuple[int, os.stat_result]:
    """A plain file, opened."""
    try:
        if file.is_symlink():
            raise CheckpointError(f"{file} is a link; links in runs are not followed")
        handle = os.open(file, os.O_RDONLY | _NO_LINKS)  # a pipe must not make this wait
    except (FileNotFoundError, NotADirectoryError) as error:
        raise FileNotFoundError(*error.args) from None
    except (OSError, ValueError) as error:
        why = (
            "it is no plain file"
            if getattr(error, "errno", None) in _ODD
            else getattr(error, "strerror", None) or error
        )
        raise CheckpointError(f"{file} cannot be read: {why}") from None
    status = os.fstat(handle)
    if not stat.S_ISREG(status.st_mode):
        os.close(handle)
        raise CheckpointError(f"{file} is no plain file")
    return handle, status


def parse_json(data: bytes | str, file: Path) -> dict[str, Any]:
    """A JSON object, read strictly: no key twice, finite numbers of few digits, nested a few levels deep.

    Raises:
        CheckpointError: for anything else.
    """
    try:
        text = data if isinstance(data, str) else data.decode()
        value = json.loads(
            text, object_pairs_hook=_unique, parse_constant=_refuse, parse_float=_finite, parse_int=_short
        )
        _require_flat(value)
    except _Strict as error:
        raise CheckpointError(f"{file} is corrupt: {error}") from None
    except (ValueError, RecursionError):
        raise CheckpointError(f"{file} is corrupt: not JSON") from None
    if not isinstance(value, dict):
        raise CheckpointError(f"{file} is corrupt: not a JSON object")
    return value


def read_json(folder: Path, name: str, limit: int = JSON_LIMIT) -> dict[str, Any]:
    """Read a JSON object from a file that lies in a folder, links followed.

    Raises:
        CheckpointError: if the file cannot be read, or holds anything else.
        FileNotFoundError: if it is not there.
    """
    file = folder / name
    try:
        require_inside(folder, file)
        return parse_json(read_file(file, limit), file)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise CheckpointError(f"{file} cannot be read: {error.strerror or error}") from None


def require_inside(folder: Path, file: Path) -> None:
    """Check that a file lies in a folder, links followed.

    Raises:
        OSError: if a link leads elsewhere.
    """
    real = Path(os.path.realpath(file))  # where resolve() would raise something else for a link to itself
    if not real.is_relative_to(os.path.realpath(folder)):
        raise OSError(errno.ELOOP, "it is a link that leads elsewhere", str(file))


def refuse_links(folder: Path) -> None:
    """A run holds no links: what is written to it must not go elsewhere.

    Raises:
        CheckpointError: naming the first.
    """
    try:
        links = sorted(entry.name for entry in os.scandir(folder) if entry.is_symlink())
    except OSError as error:
        raise CheckpointError(f"{folder} cannot be read: {error.strerror}") from None
    if links:
        raise CheckpointError(f"{folder / links[0]} is a link; links in runs are not followed")


class _Strict(ValueError):
    """Valid JSON that is refused all the same."""


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    if len(value) != len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise _Strict(f"key '{twice[:40]}' stands there twice")
    return value


def _refuse(name: str) -> NoReturn:
    raise _Strict(f"{name} is no number of JSON")


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise _Strict(f"number {text[:20]} is out of range")
    return value


def _short(text: str) -> int:
    if len(text) > _DIGITS:
        raise _Strict(f"a number has {len(text)} digits")
    return int(text)


def _require_flat(value: object) -> None:
    level = [value]
    for _ in range(_DEPTH):
        level = [
            inner
            for outer in level
            if isinstance(outer, dict | list)
            for inner in (outer.values() if isinstance(outer, dict) else outer)
        ]
        if not level:
            return
    raise _Strict(f"it is nested more than {_DEPTH} levels deep")


_ODD = (errno.ELOOP, errno.ENXIO, errno.EISDIR)

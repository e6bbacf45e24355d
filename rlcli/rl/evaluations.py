"""The evaluations that a run keeps: of each of its checkpoints the document that `rlcli eval` wrote last."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rlcli.errors import CheckpointError
from rlcli.rl.files import disk_error, to_json, write_atomic
from rlcli.rl.reading import parse_json, read_file
from rlcli.rl.run import Run, require_inside, require_own

FOLDER = "evaluations"
"""Of a run; `STEP.json` in it is of the checkpoint whose folder has that name."""
_LIMIT = 1024 * 1024
_STEP = re.compile("[0-9]{1,30}")


class _Checked(BaseModel):
    model_config = ConfigDict(strict=True, allow_inf_nan=False)


class _Mean(_Checked):
    mean: float
    std: float
    low: float | None
    high: float | None


class _Share(_Checked):
    rate: Annotated[float, Field(ge=0.0, le=1.0)]
    low: float
    high: float


Name = Annotated[str, Field(max_length=500)]


class _Document(_Checked):
    """What is relied on; the document may hold more."""

    command: Literal["eval"]
    episodes: Annotated[int, Field(ge=1)]
    seed: Annotated[int, Field(ge=0)]
    returns: Annotated[_Mean, Field(alias="return")]
    length: _Mean
    success: _Share | None = None
    reward_terms: Annotated[dict[Name, _Mean], Field(max_length=10_000)]
    terminations: Annotated[dict[Name, _Share], Field(max_length=10_000)]
    diverged: Annotated[int, Field(ge=0)]
    diverged_by: Annotated[dict[Name, int], Field(max_length=10_000)]


def keep_evaluation(run: Run, step_name: str, document: Mapping[str, Any]) -> Path:
    """Write the document of an evaluation of a run's checkpoint; an older one of that checkpoint is replaced.

    Args:
        run: the run.
        step_name: the name of the checkpoint's folder.
        document: what `rlcli eval --json` prints.

    Raises:
        CheckpointError: if the run's folder is not as rlcli makes one: it may lead elsewhere.
        MachineError: if the disk refuses.
    """
    require_own(run, FOLDER)
    file = _file(run, step_name)
    try:
        file.parent.mkdir(exist_ok=True)
    except OSError as error:
        raise disk_error(file.parent, error) from error
    write_atomic(file, to_json(dict(document)))
    return file


def read_evaluation(run: Run, step_name: str) -> dict[str, Any] | None:
    """The newest evaluation of a run's checkpoint; None where there is none.

    Of the document these are certain to be there, and of their kind: `episodes`, `seed`, `return` and `length` (mean,
    std, low, high; of a single episode the ends are None), `reward_terms` (the same by name), `terminations` (rate,
    low, high by name), `diverged`, `diverged_by`, and `success` (rate, low, high) or nothing of that name.

    Raises:
        CheckpointError: if it is not such a document.
    """
    file = _file(run, step_name)
    try:
        require_inside(run.folder, file)
        document = parse_json(read_file(file, _LIMIT), file)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except OSError as error:
        raise CheckpointError(f"{file} cannot be read: {error.strerror or error}") from None
    try:
        _Document.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(map(str, first["loc"])) or "all"
        raise CheckpointError(
            f"{file} is no evaluation: {place[:80]}: {first['msg']}", hint="rlcli eval writes it anew"
        ) from None
    if document.get("success", 0) is None:
        del document["success"]
    return document


def _file(run: Run, step_name: str) -> Path:
    if not _STEP.fullmatch(step_name):
        raise CheckpointError(f"'{step_name[:40]}' is not the name of a checkpoint's folder")
    return run.folder / FOLDER / f"{step_name}.json"

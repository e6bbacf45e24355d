"""The evaluations that a run keeps: of each of its checkpoints the document that `rlcli eval` wrote last."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from rlcli.errors import CheckpointError
from rlcli.runs.atomic_io import disk_error, to_json, write_atomic
from rlcli.runs.run import Run, require_own
from rlcli.runs.safe_io import FileModel, check_json, read_json

FOLDER = "evaluations"
"""Of a run; `STEP.json` in it is of the checkpoint whose folder has that name."""
_LIMIT = 1024 * 1024
_STEP = re.compile("[0-9]{1,30}")


class _Mean(FileModel):
    mean: float
    std: float
    low: float | None
    high: float | None


class _Share(FileModel):
    rate: Annotated[float, Field(ge=0.0, le=1.0)]
    low: float
    high: float


Name = Annotated[str, Field(max_length=500)]


class _Document(FileModel):
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
        document = read_json(run.folder, f"{FOLDER}/{file.name}", _LIMIT)
    except FileNotFoundError:
        return None
    check_json(_Document, document, file, hint="rlcli eval writes it anew")
    if document.get("success", 0) is None:
        del document["success"]
    return document


def _file(run: Run, step_name: str) -> Path:
    if not _STEP.fullmatch(step_name):
        raise CheckpointError(f"'{step_name[:40]}' is not the name of a checkpoint's folder")
    return run.folder / FOLDER / f"{step_name}.json"

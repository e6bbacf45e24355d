"""Read and write the evaluations stored in a run: the last result of `rlcli eval` for each checkpoint."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from rlcli.errors import CheckpointError
from rlcli.runs.atomic_io import disk_errors, to_json, write_atomic
from rlcli.runs.run import Run, require_own
from rlcli.runs.safe_io import FileModel, check_json, read_json

FOLDER = "evaluations"
"""Name of the folder in a run; its file `STEP.json` belongs to the checkpoint whose folder is named STEP."""
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


class _Condition(FileModel):
    held: _Share
    value: _Mean | None = None
    at_least: float | None = None
    at_most: float | None = None


Name = Annotated[str, Field(max_length=500)]


class _EvaluationRecord(FileModel):
    """The entries of a stored evaluation that rlcli reads; the file may have further entries."""

    command: Literal["eval"]
    episodes: Annotated[int, Field(ge=1)]
    seed: Annotated[int, Field(ge=0)]
    returns: Annotated[_Mean, Field(alias="return")]
    length: _Mean
    success: _Share | None = None
    conditions: Annotated[dict[Name, _Condition], Field(max_length=1_000, default_factory=dict)]
    reward_terms: Annotated[dict[Name, _Mean], Field(max_length=10_000)]
    terminations: Annotated[dict[Name, _Share], Field(max_length=10_000)]
    diverged: Annotated[int, Field(ge=0)]
    diverged_by: Annotated[dict[Name, int], Field(max_length=10_000)]


def write_evaluation(run: Run, step_name: str, document: Mapping[str, Any]) -> Path:
    """Write the result of an evaluation of a run's checkpoint; it replaces an older result for that checkpoint.

    Args:
        run: the run.
        step_name: name of the checkpoint's folder.
        document: the JSON document that `rlcli eval --json` prints.

    Raises:
        CheckpointError: if the folder `evaluations` has links out of the run, or pipes or devices; or `step_name` is
            not a number.
        MachineError: if the disk reports an error.
    """
    require_own(run, FOLDER)
    file = _file(run, step_name)
    with disk_errors(file.parent):
        file.parent.mkdir(exist_ok=True)
    return write_atomic(file, to_json(dict(document)))


def read_evaluation(run: Run, step_name: str) -> dict[str, Any] | None:
    """Return the saved result of `rlcli eval` for a run's checkpoint; None if there is none.

    These entries of the result are checked:

    - `episodes`, `seed`, `diverged`, `diverged_by`
    - `return`, `length`: mean, std, low, high; for a single episode low and high are None
    - `reward_terms`: name of a term -> mean, std, low, high
    - `terminations`: name of a term -> rate, low, high
    - `success`: rate, low, high; missing for a task without success conditions
    - `conditions`: name of a success condition -> `held` (rate, low, high), `at_least` or `at_most` if the condition
      has such a limit, and `value` (mean, std, low, high) if the condition has a value; missing in the same case

    Args:
        run: the run.
        step_name: name of the checkpoint's folder.

    Raises:
        CheckpointError: if the file is malformed.
    """
    file = _file(run, step_name)
    try:
        document = read_json(run.folder, f"{FOLDER}/{file.name}", _LIMIT)
    except FileNotFoundError:
        return None
    check_json(_EvaluationRecord, document, file, hint="run `rlcli eval` again to replace the file")
    if document.get("success", 0) is None:
        del document["success"]
    return document


def _file(run: Run, step_name: str) -> Path:
    if not _STEP.fullmatch(step_name):
        raise CheckpointError(
            f"'{step_name[:40]}' is not the name of a checkpoint's folder; give the checkpoint's step with 12 digits"
        )
    return run.folder / FOLDER / f"{step_name}.json"

"""Create and read studies: folders with several runs, of one configuration with several seeds or of a sweep's trials.

The entry `kind` of study.json is `seeds` or `sweep`. This module imports neither torch nor MuJoCo.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from rlcli.errors import CheckpointError, UsageError
from rlcli.runs.atomic_io import disk_errors, to_json, write_atomic
from rlcli.runs.run import STUDY, WAITING, initialize_run, new_folder, require_plain_run
from rlcli.runs.safe_io import FileModel, check_json, read_json, require_plain_entries
from rlcli.safe_text import MAX_SEED

_MAX_SEEDS = 1000
_LIMIT = 1024 * 1024
_PART = re.compile(r"([0-9]{1,19})(?:\.\.([0-9]{1,19}))?")


def read_seeds(text: str) -> list[int]:
    """Parse the option `--seeds`: a range `0..4` (both ends included), a list `1,5,9`, or a list of ranges.

    Raises:
        UsageError: for other text, an empty range, a repeated seed, or too many seeds.
    """
    seeds: list[int] = []
    for part in text.split(","):
        found = _PART.fullmatch(part.strip())
        if found is None:
            message = f"--seeds '{text}': '{part.strip()}' is neither a seed nor a range"
            raise UsageError(message, hint="write a range or a list, such as --seeds 0..4 or --seeds 1,5,9")
        first, last = int(found[1]), int(found[2] or found[1])
        if last < first:
            raise UsageError(f"--seeds '{text}': the range {part.strip()} is empty", hint=f"write {last}..{first}")
        if last > MAX_SEED or last - first >= _MAX_SEEDS or len(seeds) > _MAX_SEEDS:
            raise UsageError(f"--seeds '{text}': give at most {_MAX_SEEDS} seeds, each up to {MAX_SEED}")
        seeds += range(first, last + 1)
    twice = sorted({seed for seed in seeds if seeds.count(seed) > 1})
    if twice:
        raise UsageError(f"--seeds '{text}' has {twice[0]} twice; give each seed once")
    return seeds


def create_study(
    runs_dir: Path, task: str, name: str | None, config: str, record: Mapping[str, Any], seeds: Sequence[int]
) -> Path:
    """Create the folder of a study of several seeds, with a run for each seed, and return the folder.

    The runs are not started yet: their state is `waiting`.

    Args:
        runs_dir: the folder of runs.
        task: name of the task.
        name: part of the name of the study's folder; None: the name is only a time.
        config: the resolved configuration, as YAML.
        record: the first content of each run's run.json.
        seeds: the seeds.

    Raises:
        UsageError: if the name cannot be part of a folder's name.
        MachineError: if the folder cannot be written; it is deleted.
    """
    folder = new_folder(runs_dir, task, name)
    names = [f"seed-{seed}" for seed in seeds]
    study = {"kind": "seeds", "task": task, "seeds": list(seeds), "runs": names, "device": record["device"]}
    with disk_errors(folder, remove=True):
        write_atomic(folder / STUDY, to_json(study))
        for seed, run_name in zip(seeds, names, strict=True):
            (folder / run_name).mkdir()
            initialize_run(folder / run_name, config, {**record, "seed": seed, "state": WAITING}).unlock()
    return folder


class _StudyRecord(FileModel):
    kind: Literal["seeds", "sweep"]
    task: str


class _StudyRuns(FileModel):
    runs: list[Annotated[str, Field(pattern="^seed-[0-9]{1,19}$")]] = Field(min_length=1, max_length=_MAX_SEEDS)


def read_study(folder: Path, kind: str = "seeds") -> dict[str, Any]:
    """Read and check study.json of a study. `kind` is `seeds` (runs of several seeds) or `sweep`.

    Raises:
        CheckpointError: if the folder is not a study of this kind, if study.json is malformed, or if the folder or one
            of its runs has links, pipes or devices.
    """
    require_plain_study(folder)
    record = read_json(
        folder, STUDY, _LIMIT, missing=f"{folder} is not a study of several runs: it has no {STUDY}; check the path"
    )
    check_json(_StudyRecord, record, folder / STUDY)
    if record["kind"] != kind:
        raise CheckpointError(f"{folder} is of kind {record['kind']}, expected {kind}; choose another folder")
    return record


def require_plain_study(folder: Path) -> None:
    """Check that a study and its runs contain only regular files and folders; a folder that does not exist is valid.

    Raises:
        CheckpointError: for the first entry that is a link, a pipe or a device.
    """
    if folder.is_dir():
        require_plain_entries(folder)
        for run in sorted(entry for entry in folder.iterdir() if entry.is_dir()):
            require_plain_run(run)


def runs_of(folder: Path, record: Mapping[str, Any]) -> list[Path]:
    """Return the folders of the runs of a study of several seeds. `record` is the content of study.json.

    Raises:
        CheckpointError: if the record has no runs, or a run whose name is not `seed-N`.
    """
    names = check_json(_StudyRuns, record, folder / STUDY).runs
    return [folder / name for name in names]

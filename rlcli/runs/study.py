"""Studies: one configuration trained with several seeds, in one folder; light, for whoever starts the trainings."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from rlcli.errors import CheckpointError, MachineError, UsageError
from rlcli.runs.atomic_io import disk_error, to_json, write_atomic
from rlcli.runs.run import MAX_SEED, STUDY, WAITING, begin_run, new_folder
from rlcli.runs.safe_io import FileModel, check_json, read_json

_MOST_SEEDS = 1000
_LIMIT = 1024 * 1024
_PART = re.compile(r"([0-9]{1,19})(?:\.\.([0-9]{1,19}))?")


def read_seeds(text: str) -> list[int]:
    """`0..4` (both included), `1,5,9`, or both.

    Raises:
        UsageError: for anything else, an empty range, a seed twice, or too many.
    """
    seeds: list[int] = []
    for part in text.split(","):
        found = _PART.fullmatch(part.strip())
        if found is None:
            raise UsageError(f"--seeds '{text}': '{part.strip()}' is no seed", hint="as in --seeds 0..4 or 1,5,9")
        first, last = int(found[1]), int(found[2] or found[1])
        if last < first:
            raise UsageError(f"--seeds '{text}': {part.strip()} is empty", hint=f"{last}..{first}")
        if last > MAX_SEED or last - first >= _MOST_SEEDS or len(seeds) > _MOST_SEEDS:
            raise UsageError(f"--seeds '{text}': at most {_MOST_SEEDS} seeds, each up to {MAX_SEED}")
        seeds += range(first, last + 1)
    twice = sorted({seed for seed in seeds if seeds.count(seed) > 1})
    if twice:
        raise UsageError(f"--seeds '{text}' names {twice[0]} twice")
    return seeds


def create_study(
    runs_dir: Path, task: str, name: str | None, config: str, record: Mapping[str, Any], seeds: Sequence[int]
) -> Path:
    """A folder with a run for every seed, all of them waiting.

    Raises:
        UsageError: for a name that cannot be part of a folder's.
        MachineError: if it cannot be written; the folder is gone then.
    """
    folder = new_folder(runs_dir, task, name)
    try:
        names = [f"seed-{seed}" for seed in seeds]
        about = {"kind": "seeds", "task": task, "seeds": list(seeds), "runs": names, "device": record["device"]}
        write_atomic(folder / STUDY, to_json(about))
        for seed, run_name in zip(seeds, names, strict=True):
            (folder / run_name).mkdir()
            begin_run(folder / run_name, config, {**record, "seed": seed, "state": WAITING}).unlock()
    except (OSError, MachineError) as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise disk_error(folder, error) if isinstance(error, OSError) else error from error
    return folder


class _StudyRecord(FileModel):
    kind: Literal["seeds", "sweep"]
    task: str


class _StudyRuns(FileModel):
    runs: list[Annotated[str, Field(pattern="^seed-[0-9]{1,19}$")]] = Field(min_length=1, max_length=_MOST_SEEDS)


def read_study(folder: Path, kind: str = "seeds") -> dict[str, Any]:
    """What a study says of itself, checked.

    Raises:
        CheckpointError: if it is not one of this kind, or damaged.
    """
    try:
        about = read_json(folder, STUDY, _LIMIT)
    except FileNotFoundError:
        raise CheckpointError(f"{folder} is not a study: it has no {STUDY}") from None
    check_json(_StudyRecord, about, folder / STUDY)
    if about["kind"] != kind:
        raise CheckpointError(f"{folder} is a study of {about['kind']}, not of {kind}")
    return about


def runs_of(folder: Path, about: Mapping[str, Any]) -> list[Path]:
    """The folders of a study's runs.

    Raises:
        CheckpointError: if it names what cannot be one of them.
    """
    names = check_json(_StudyRuns, about, folder / STUDY).runs
    return [folder / name for name in names]


def write_summary(folder: Path, name: str, content: bytes | str) -> Path:
    """A file of a study.

    Raises:
        MachineError: if it cannot be written.
    """
    write_atomic(folder / name, content)
    return folder / name

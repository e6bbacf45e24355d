"""Prepare `rlcli reproduce`, which trains a run again and compares the results.

The functions check that the run can be reproduced, and create the folder of the new run.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlcli.config.strict_yaml import MAX_BYTES
from rlcli.errors import CheckpointError, UsageError
from rlcli.runs.checkpoint_reader import open_checkpoint, steps
from rlcli.runs.provenance import differences
from rlcli.runs.run import Run, create_run
from rlcli.runs.run_diff import last_iteration
from rlcli.runs.safe_io import read_file

IRRELEVANT = ("engine_threads",)
"""Entries of run.json that do not affect the results: physics is the same for any number of engine threads."""


def require_reproducible(run: Run) -> None:
    """Check that a run can be reproduced bit by bit: it was trained by one process on a CPU.

    Raises:
        UsageError: if the run was trained in another way, or has no finished iteration.
    """
    device, processes = str(run.record.get("device", "cpu")), run.record.get("processes", 1)
    if device != "cpu":
        raise UsageError(
            f"{run.folder} was trained on {device}, where sums have no fixed order: it cannot be reproduced bit by bit",
            hint="train again with other seeds, and compare the policies with `rlcli eval`",
        )
    if processes != 1:
        message = f"{run.folder} was trained by {processes} processes, and only runs of one process can be reproduced"
        raise UsageError(message, hint="choose another run")
    if last_iteration(run) < 1:
        raise UsageError(f"{run.folder} has no finished iteration to reproduce; choose another run")


def changed_entries(run: Run, now: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Return the versions and properties of the machine that have changed since a run and affect its results.

    Args:
        run: the run.
        now: the record of the present software and machine, from `rlcli.runs.provenance`.

    Returns:
        (dotted name, value in run.json, present value) of each changed entry.
    """
    return [row for row in differences(run.record, now) if row[0] not in IRRELEVANT]


def milestones(run: Run, until: int) -> list[int]:
    """Return the iterations at which a reproduction is compared with the run, ascending.

    They are the iterations before `until` at which the run has a checkpoint, and `until` itself.
    """
    saved = [open_checkpoint(run.checkpoints / f"{step:012d}").manifest for step in steps(run.checkpoints)]
    iterations = [entry["iteration"] for entry in saved if isinstance(entry.get("iteration"), int)]
    return sorted({i for i in iterations if 0 < i < until} | {until})


def create_reproduction(original: Run, runs_dir: Path, name: str, now: Mapping[str, Any]) -> tuple[Run, Path | None]:
    """Create a run with the configuration, seed and number of threads of another run.

    Args:
        original: the run to reproduce.
        runs_dir: folder of the new run.
        name: part of the name of its folder.
        now: the record of the present software and machine, from `rlcli.runs.provenance`.

    Returns:
        The new run, and the checkpoint with the initial weights of both runs; None for random weights.

    Raises:
        CheckpointError: if the checkpoint with the initial weights has changed since the original run started.
    """
    was = original.record
    initial = Path(was["init_from"]) if was.get("init_from") else None
    if initial is not None:
        policy = open_checkpoint(initial).manifest["files"].get("policy.safetensors", {}).get("sha256")
        if policy != was.get("init_from_sha256", policy):
            raise CheckpointError(
                f"the policy in {initial} has changed since the run started from it; restore the old file"
            )
    kept: dict[str, Any] = {
        key: was[key]
        for key in ("seed", "device", "task", "agent", "init_from", "init_from_sha256", "given", "torch_threads")
        if key in was
    }
    record: dict[str, Any] = {**now, **kept, "loggers": [], "reproduces": str(original.folder)}
    config = read_file(original.config, MAX_BYTES).decode()
    return create_run(runs_dir, was["task"]["name"], name, config, record), initial

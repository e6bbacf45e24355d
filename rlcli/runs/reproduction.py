"""Doing a run again: whether that is possible, what it needs, and where to save so that both can be compared."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rlcli.errors import CheckpointError, UsageError
from rlcli.runs.checkpoint import open_checkpoint, steps
from rlcli.runs.provenance import differences
from rlcli.runs.run import Run, create_run
from rlcli.runs.run_diff import reached

IRRELEVANT = ("engine_threads",)
"""Entries of the environment that change no bit: physics is the same at any number of threads."""


def require_reproducible(run: Run) -> None:
    """Bits are promised of a run by one process on the CPU.

    Raises:
        UsageError: for any other run, and for one without an iteration.
    """
    device, processes = str(run.record.get("device", "cpu")), run.record.get("processes", 1)
    if device != "cpu":
        raise UsageError(
            f"{run.folder} was trained on {device}, where sums have no fixed order: no bits are promised there",
            hint="train again with other seeds, and compare the policies with rlcli eval",
        )
    if processes != 1:
        raise UsageError(f"{run.folder} was trained by {processes} processes; one trains other bits")
    if reached(run) < 1:
        raise UsageError(f"{run.folder} has no iteration to reproduce")


def changed(run: Run, now: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """What the bits of a run depend on and is not as it was: (name, then, now)."""
    return [row for row in differences(run.record, now) if row[0] not in IRRELEVANT]


def milestones(run: Run, until: int) -> list[int]:
    """The iterations at which a run was saved, up to one, and that one."""
    saved = [open_checkpoint(run.checkpoints / f"{step:012d}").manifest for step in steps(run.checkpoints)]
    iterations = [entry["iteration"] for entry in saved if isinstance(entry.get("iteration"), int)]
    return sorted({i for i in iterations if 0 < i < until} | {until})


def create_again(original: Run, runs_dir: Path, name: str, now: Mapping[str, Any]) -> tuple[Run, Path | None]:
    """A new run with the configuration, seed and threads of another; and the checkpoint that both begin from.

    Args:
        original: the run to do again.
        runs_dir: where the new run goes.
        name: part of its folder's name.
        now: the record of the environment as it is.

    Raises:
        CheckpointError: if the checkpoint that the run began from is not what it was.
    """
    was = original.record
    initial = Path(was["init_from"]) if was.get("init_from") else None
    if initial is not None:
        policy = open_checkpoint(initial).manifest["files"].get("policy.safetensors", {}).get("sha256")
        if policy != was.get("init_from_sha256", policy):
            raise CheckpointError(f"{initial}: its policy is not the one that the run began with")
    kept: dict[str, Any] = {
        key: was[key]
        for key in ("seed", "device", "task", "agent", "init_from", "init_from_sha256", "given", "torch_threads")
        if key in was
    }
    record: dict[str, Any] = {**now, **kept, "loggers": [], "reproduces": str(original.folder)}
    config = original.config.read_text(encoding="utf-8")
    return create_run(runs_dir, was["task"]["name"], name, config, record), initial

"""Comparison of two runs: trained weights bit for bit, logs, and no leftover files."""

import hashlib
import json
from pathlib import Path
from typing import Any

import torch

from rlcli.replay.failure_cases import FOLDER
from rlcli.replay.trajectory import read_trajectory
from rlcli.runs.checkpoint_reader import Checkpoint, open_checkpoint, steps
from rlcli.runs.metric_rows import read_rows
from rlcli.runs.run import open_run

CONSTANT = "Perf/"
"""Prefix of metrics that are times."""


def rows_of(run: Path) -> list[dict[str, Any]]:
    """Return the metrics without times."""
    return [{k: v for k, v in row.items() if not k.startswith(CONSTANT)} for row in read_rows(run / "metrics.jsonl")]


def newest(run: Path) -> Checkpoint:
    return open_checkpoint(run / "checkpoints" / f"{steps(run / 'checkpoints')[-1]:012d}")


def content(checkpoint: Checkpoint) -> dict[str, str]:
    """Return the sha256 of every part of a checkpoint and of its rows, independent of how files divide them."""
    hashes = {name: entry["sha256"] for name, entry in checkpoint.manifest["files"].items()}
    for name, log in checkpoint.state().logs.items():
        for column, values in log.read(log.first, log.stop).items():
            data = values.contiguous().numpy().tobytes()
            hashes[f"{name}.{column} {log.first}-{log.stop}"] = hashlib.sha256(data).hexdigest()
    return hashes


def assert_loads(run: Path) -> None:
    """Check that every checkpoint of a run is complete: files match the manifest, and all rows exist."""
    for step in steps(run / "checkpoints"):
        assert content(open_checkpoint(run / "checkpoints" / f"{step:012d}"))


def leftovers(run: Path) -> list[str]:
    """Return temporary files, and rows of logs that no checkpoint needs."""
    found = [str(file) for file in run.rglob("*") if ".tmp" in file.name]
    needed = set()
    for step in steps(run / "checkpoints"):
        for name, shards in open_checkpoint(run / "checkpoints" / f"{step:012d}").shards().items():
            needed |= {f"{name}/{shard.file}" for shard in shards}
    have = {f"{file.parent.name}/{file.name}" for file in (run / "checkpoints/logs").glob("*/*")}
    return found + sorted(have - needed)


def assert_cases(run: Path) -> None:
    """Check that every recorded episode is complete, belongs to the finished run, and exists once."""
    keys = []
    for file in (run / FOLDER).glob("*.safetensors"):
        header = read_trajectory(file).header
        assert header.failure is not None
        assert header.failure.step <= newest(run).step
        keys.append((header.episodes[0].env, header.episodes[0].index))
    assert len(keys) == len(set(keys))


def tensorboard_steps(run: Path) -> dict[str, list[int]]:
    """Return the steps of every scalar except times, in the order of the files."""
    from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

    found: dict[str, list[int]] = {}
    for file in sorted((run / "tb").glob("events.out.tfevents.*")):
        for event in EventFileLoader(str(file)).Load():
            for value in event.summary.value:
                found.setdefault(value.tag, []).append(event.step)
    return {tag: sorted(steps) for tag, steps in found.items() if not tag.startswith(CONSTANT)}


def assert_same_run(run: Path, whole: Path, *, state: str = "finished") -> None:
    """Check that an interrupted and resumed run equals an uninterrupted one."""
    assert_cases(run)
    assert rows_of(run) == rows_of(whole)
    wanted, found = content(newest(whole)), content(newest(run))
    assert found == wanted
    assert leftovers(run) == []
    record, expected = (json.loads((folder / "run.json").read_text()) for folder in (run, whole))
    for key in ("iteration", "step", "best", "seed"):
        assert record.get(key) == expected.get(key), key
    assert record["state"] == state
    assert (run / "checkpoints/latest").read_text().strip() == newest(run).folder.name
    if (whole / "tb").exists():
        assert tensorboard_steps(run) == tensorboard_steps(whole)
    locked = open_run(run)
    locked.lock()
    locked.unlock()


def same_tensors(left: dict[str, torch.Tensor], right: dict[str, torch.Tensor]) -> list[str]:
    """Return the names of tensors that differ in any bit."""
    if left.keys() != right.keys():
        return sorted(left.keys() ^ right.keys())
    return [name for name in left if left[name].numpy().tobytes() != right[name].numpy().tobytes()]

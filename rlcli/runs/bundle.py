"""A policy without its training: a small folder that ships with a task, or that somebody passes on.

It is a checkpoint reduced to what acting needs, `policy.json` and `policy.safetensors`, with a manifest that says what
the policy was trained for and where it comes from. It is read like any checkpoint, with the same checks.
"""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import safetensors.torch
from pydantic import Field

from rlcli.errors import CheckpointError, UsageError, VerdictError
from rlcli.runs.atomic_io import disk_error, sync_folder, to_json, write_synced
from rlcli.runs.checkpoint import FORMAT, Checkpoint, open_checkpoint, sha256
from rlcli.runs.checkpoint_manifest import layout_of
from rlcli.runs.restore import policy_of
from rlcli.runs.run import Run, TaskRecord
from rlcli.runs.safe_io import JSON_LIMIT, FileModel, Word, check_json, parse_json, read_file

BUNDLE = 1
"""Version of what a bundle's manifest says, under the key `bundle`."""


class _BundleRecord(FileModel):
    """The part of a manifest that only a bundle has."""

    task: TaskRecord
    agent: Annotated[Word, Field(max_length=200)] | None = None


@dataclass(frozen=True, slots=True)
class Bundle:
    """A bundle that was found; its tensors are checked as they are read."""

    folder: Path
    manifest: Mapping[str, Any]

    @property
    def task(self) -> dict[str, Any]:
        """The record of the task that it was trained in."""
        return dict(self.manifest["task"])

    @property
    def agent(self) -> str | None:
        """Which of the task's agents trained it."""
        return self.manifest.get("agent")


def is_bundle(folder: Path) -> bool:
    """Whether a folder's manifest says that it is a bundle; whether it is a good one, `open_bundle` finds out.

    Raises:
        CheckpointError: if it has a manifest that cannot be read.
    """
    file = folder / "manifest.json"
    if not os.path.isfile(file):  # of a name that is too long for the system, too: no
        return False
    return "bundle" in parse_json(read_file(file, JSON_LIMIT), file)


def open_bundle(folder: Path) -> Bundle:
    """A bundle whose manifest makes sense.

    Raises:
        CheckpointError: if it is none, or of another version.
    """
    manifest = open_checkpoint(folder).manifest
    version = manifest.get("bundle")
    if type(version) is not int or version != BUNDLE:
        raise CheckpointError(
            f"{folder} has bundle version {str(version)[:40]}; this rlcli reads {BUNDLE}",
            hint="use the rlcli version that its manifest.json names",
        )
    check_json(_BundleRecord, manifest, folder / "manifest.json")
    return Bundle(folder, manifest)


def check_bundle_target(output: Path) -> None:
    """A bundle is written to a new folder, or in place of an older bundle.

    Raises:
        UsageError: if something else is there.
    """
    if not output.name:
        raise UsageError(f"--output {output} is no folder of a bundle", hint="--output FOLDER")
    if output.is_symlink() or (output.exists() and not output.is_dir()):
        raise UsageError(f"--output {output} is no folder", hint="a bundle is a folder of its own")
    if output.is_dir() and any(output.iterdir()) and not is_bundle(output):
        raise UsageError(f"--output {output} is there already, and is no bundle", hint="name a folder of its own")


def write_bundle(checkpoint: Checkpoint, output: Path, run: Run | None, evaluation: Mapping[str, Any] | None) -> Bundle:
    """Write the policy of a checkpoint as a bundle, and read it back.

    Args:
        checkpoint: the checkpoint.
        output: the folder; an older bundle there is replaced.
        run: the run that it lies in, for where it was trained and how long.
        evaluation: what `rlcli eval` found of it.

    Raises:
        CheckpointError: if the checkpoint is corrupt, or does not say what the policy's columns are.
        UsageError: if something else is in the place.
        MachineError: if the disk refuses; what was there before is untouched.
        VerdictError: if what was written does not read back as the same policy; it is not kept.
    """
    check_bundle_target(output)
    policy = policy_of(checkpoint)
    layout_of(checkpoint, policy)
    weights = {name: value.contiguous() for name, value in sorted(policy.state_dict().items())}
    contents = {
        "policy.json": to_json(policy.spec.model_dump(mode="json")).encode(),
        "policy.safetensors": safetensors.torch.save(weights),
    }
    saved = checkpoint.manifest
    manifest = {
        "format": FORMAT,
        "bundle": BUNDLE,
        "step": checkpoint.step,
        "iteration": checkpoint.iteration,
        "task": _portable_task(saved.get("task")),
        **{key: saved.get(key) for key in ("agent", "trainer", "seed", "versions")},
        "origin": saved.get("origin") if run is None else _origin(run),
        "evaluation": saved.get("evaluation") if evaluation is None else _evaluation_summary(evaluation),
        "layout": saved["layout"],
        **({"deployment": saved["deployment"]} if saved.get("deployment") is not None else {}),
        "files": {name: {"size": len(data), "sha256": sha256(data)} for name, data in contents.items()},
    }
    _write_folder(output, {**contents, "manifest.json": to_json(manifest).encode()}, checkpoint)
    return open_bundle(output)


def _write_folder(output: Path, contents: Mapping[str, bytes], checkpoint: Checkpoint) -> None:
    """Write beside, read back, then one rename."""
    beside = f".{output.name}.tmp-{os.getpid()}-{secrets.token_hex(4)}"
    fresh, old = output.parent / beside, output.parent / f"{beside}-old"
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        fresh.mkdir()
        for name, data in contents.items():
            write_synced(fresh / name, data)
        sync_folder(fresh)
        _require_same_policy(checkpoint, fresh, output)
        if output.exists():
            output.rename(old)
        try:
            fresh.rename(output)
        except OSError:
            if old.exists():
                old.rename(output)
            raise
        sync_folder(output.parent)
    except OSError as error:
        raise disk_error(output, error) from error
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def _require_same_policy(checkpoint: Checkpoint, fresh: Path, output: Path) -> None:
    open_bundle(fresh)
    before, after = checkpoint.policy(), open_checkpoint(fresh).policy()
    theirs = after.state_dict()
    same = before.spec == after.spec and all(
        bool((value == theirs[name]).all()) for name, value in before.state_dict().items()
    )
    if not same:
        raise VerdictError(f"{output} is not kept: it does not read back as the checkpoint's policy")


def _portable_task(record: object) -> dict[str, Any]:
    """The task without the place where it lay on a machine."""
    record = record if isinstance(record, Mapping) else {}
    return {key: record.get(key) for key in ("name", "distribution", "version")}


def _origin(run: Run) -> dict[str, Any]:
    """What the policy was trained on."""
    record = run.record
    seconds = record.get("trained_s")
    return {
        "device": str(record.get("device", "cpu")).partition(":")[0],
        "processes": record.get("processes", 1),
        "gpu": record.get("torch", {}).get("gpu"),
        "cpu": record.get("cpu", {}).get("model"),
        "engine_threads": record.get("engine_threads"),
        "trained_s": None if seconds is None else round(float(seconds), 1),
    }


def _evaluation_summary(evaluation: Mapping[str, Any]) -> dict[str, Any]:
    """The figures of an evaluation, without where its files lay."""
    wanted = ("episodes", "seed", "num_envs", "success", "return", "length", "values", "terminations", "diverged")
    return {key: evaluation[key] for key in wanted if evaluation.get(key) is not None}

"""Write and read bundles: small folders that ship a trained policy without the state of its training.

A bundle is a checkpoint reduced to `policy.json`, `policy.safetensors` and a manifest, which records the policy's task
and training. A bundle is read like any checkpoint, with the same checks.
"""

import os
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import torch
from pydantic import Field

from rlcli.errors import CheckpointError, UsageError, VerdictError
from rlcli.runs.atomic_io import disk_errors, remove_leftovers, sync_folder, to_json, write_synced
from rlcli.runs.checkpoint_reader import FORMAT, Checkpoint, open_checkpoint, sha256
from rlcli.runs.layout_and_deployment import layout_of
from rlcli.runs.run import Run, TaskRecord
from rlcli.runs.safe_io import JSON_LIMIT, FileModel, PrintableText, check_json, parse_json, read_file
from rlcli.runs.tensor_bytes import tensor_bytes

BUNDLE = 1
"""Version of the bundle format, stored in the manifest under the key `bundle`."""


class _BundleRecord(FileModel):
    """Entries that the manifest.json of a bundle must have, unlike that of a run's checkpoint."""

    task: TaskRecord
    agent: Annotated[PrintableText, Field(max_length=200)] | None = None


def is_bundle(folder: Path) -> bool:
    """Return whether a folder is a bundle, by its manifest.json; `open_bundle` checks whether the bundle is valid.

    Raises:
        CheckpointError: if the manifest cannot be read.
    """
    file = folder / "manifest.json"
    if not os.path.isfile(file):  # unlike Path.is_file, False for a name that is too long for the system
        return False
    return "bundle" in parse_json(read_file(file, JSON_LIMIT), file)


def open_bundle(folder: Path) -> Checkpoint:
    """Open a bundle and check its manifest.

    In the manifest, `task` is the record of the policy's task (`TaskSource.record`), and `agent` the agent's name.

    Raises:
        CheckpointError: if the folder is not a valid bundle, or its version is not the one that this rlcli reads.
    """
    bundle = open_checkpoint(folder)
    version = bundle.manifest.get("bundle")
    if type(version) is not int or version != BUNDLE:
        message = f"{folder} has bundle version {str(version)[:40]}; this rlcli reads {BUNDLE}"
        raise CheckpointError(message, hint="install the version that wrote the bundle, or export the policy again")
    check_json(_BundleRecord, bundle.manifest, folder / "manifest.json")
    return bundle


def check_bundle_target(output: Path) -> None:
    """Check that a bundle can be written to a path: there is nothing yet, an empty folder, or an older bundle.

    Raises:
        UsageError: if there is anything else.
    """
    if not output.name:
        raise UsageError(f"--output {output} has no folder name", hint="give --output FOLDER")
    if output.is_symlink():
        raise UsageError(f"--output {output} is a link", hint="give the folder itself, or the name of a new folder")
    if output.exists() and not output.is_dir():
        raise UsageError(f"--output {output} is not a folder", hint="give the name of a new folder")
    if output.is_dir() and any(output.iterdir()) and not is_bundle(output):
        raise UsageError(f"--output {output} exists and is not a bundle", hint="name a new folder or an older bundle")


def write_bundle(
    checkpoint: Checkpoint, output: Path, run: Run | None, evaluation: Mapping[str, Any] | None
) -> Checkpoint:
    """Write the policy of a checkpoint as a bundle, and read it back.

    Args:
        checkpoint: the checkpoint.
        output: the folder; an older bundle in it is replaced.
        run: the run of the checkpoint, which records the hardware and duration of the training; None: the checkpoint's
            own entry `origin`, if it has one.
        evaluation: the result of `rlcli eval` for this checkpoint; None: the checkpoint's own entry, if it has one.

    Raises:
        CheckpointError: if the checkpoint is corrupt, or its manifest has no layout of the policy's columns.
        UsageError: if the folder holds anything but a bundle.
        MachineError: if the disk reports an error; an older bundle is unchanged.
        VerdictError: if the policy read back from the files differs from the checkpoint's; the files are deleted.
    """
    check_bundle_target(output)
    policy = checkpoint.policy()
    layout_of(checkpoint, policy)
    weights = {name: value.contiguous() for name, value in sorted(policy.state_dict().items())}
    contents = {
        "policy.json": to_json(policy.spec.model_dump(mode="json")).encode(),
        "policy.safetensors": tensor_bytes(weights),
    }
    saved = checkpoint.manifest
    manifest = {
        "format": FORMAT,
        "bundle": BUNDLE,
        "step": checkpoint.step,
        "iteration": checkpoint.iteration,
        "task": _portable_task(saved.get("task")),
        **{key: saved.get(key) for key in ("agent", "trainer", "seed", "versions")},
        "origin": saved.get("origin") if run is None else _training_record(run),
        "evaluation": saved.get("evaluation") if evaluation is None else _evaluation_summary(evaluation),
        "layout": saved["layout"],
        **({"deployment": saved["deployment"]} if saved.get("deployment") is not None else {}),
        "files": {name: {"size": len(data), "sha256": sha256(data)} for name, data in contents.items()},
    }
    _write_folder(output, {**contents, "manifest.json": to_json(manifest).encode()}, checkpoint)
    return open_bundle(output)


def _write_folder(output: Path, contents: Mapping[str, bytes], checkpoint: Checkpoint) -> None:
    """Write the files of a bundle to a temporary folder, check that they hold the policy, and rename the folder.

    Args:
        output: the folder of the bundle.
        contents: file name -> content.
        checkpoint: the checkpoint with the policy.
    """
    temporary_name = f".{output.name}.tmp-{os.getpid()}-{secrets.token_hex(4)}"
    fresh, old = output.parent / temporary_name, output.parent / f"{temporary_name}-old"
    try:
        with disk_errors(output):
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
            remove_leftovers(output.parent, output.name)
            sync_folder(output.parent)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def _require_same_policy(checkpoint: Checkpoint, fresh: Path, output: Path) -> None:
    before, after = checkpoint.policy(), open_bundle(fresh).policy()
    pairs = zip(before.state_dict().values(), after.state_dict().values(), strict=True)
    if before.spec != after.spec or not all(torch.equal(value, written) for value, written in pairs):
        raise VerdictError(
            f"{output} is not kept: the policy read back from it differs from the policy of {checkpoint.folder};"
            " export the policy again, and report the bug if this repeats"
        )


def _portable_task(record: object) -> dict[str, Any]:
    """Return the record of a task (`TaskSource.record`) without paths of this machine."""
    record = record if isinstance(record, Mapping) else {}
    return {key: record.get(key) for key in ("name", "distribution", "version")}


def _training_record(run: Run) -> dict[str, Any]:
    """Return the hardware and the duration of a run's training, as a bundle's manifest records them."""
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
    """Return the results of an evaluation without file paths, as a bundle's manifest records them."""
    wanted = ("episodes", "seed", "num_envs", "success", "return", "length", "values", "terminations", "diverged")
    return {key: evaluation[key] for key in wanted if evaluation.get(key) is not None}

"""Checkpoints: folders of safetensors and JSON, complete or absent, verified before use, never unpickled."""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
from safetensors import SafetensorError
from torch import Tensor

from rlcli.errors import CheckpointError
from rlcli.machine import read_plain
from rlcli.rl.files import disk_error, sync_folder, to_json, write_atomic, write_synced
from rlcli.rl.trainer import TrainerState

FORMAT = 1
MOST_JSON = 64 * 1024 * 1024
"""Bytes of a manifest."""
PARTS = ("policy", "trainer", "env", "rng")
"""Tensor files of every checkpoint: the policy alone, critics and optimisers, environment, generators. A trainer may
add parts of its own: the replay buffer."""


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A verified checkpoint folder."""

    folder: Path
    manifest: dict[str, Any]

    @property
    def step(self) -> int:
        """Environment steps at which it was written."""
        return int(self.manifest["step"])

    def json(self, name: str) -> dict[str, Any]:
        """A JSON file of the checkpoint."""
        return _json(self._data(name), self.folder / name)

    def tensors(self, part: str) -> dict[str, Tensor]:
        """The tensors of a part.

        Raises:
            CheckpointError: if the file is not what safetensors reads.
        """
        name = f"{part}.safetensors"
        try:
            return safetensors.torch.load(self._data(name))
        except (SafetensorError, ValueError, KeyError) as error:
            raise CheckpointError(f"{self.folder / name} is corrupt: {error}") from None

    def state(self) -> TrainerState:
        """Everything a trainer goes on from."""
        missing = [part for part in PARTS if f"{part}.safetensors" not in self.manifest["files"]]
        if missing:
            raise CheckpointError(f"{self.folder} has no {missing[0]}.safetensors")
        parts = [name.removesuffix(".safetensors") for name in self.manifest["files"] if name.endswith(".safetensors")]
        tensors = {part: self.tensors(part) for part in parts}
        for part in ("policy", "trainer"):
            for name, value in tensors[part].items():
                if value.is_floating_point() and not bool(value.isfinite().all()):
                    raise CheckpointError(
                        f"{self.folder / part}.safetensors: '{name}' holds values that are not finite"
                    )
        return TrainerState(tensors, self.json("state.json"))

    def _data(self, name: str) -> bytes:
        file = self.folder / name
        entry = self.manifest["files"].get(name)
        if entry is None:
            raise CheckpointError(f"{self.folder} has no {name}")
        try:
            data = read_plain(file, entry["size"])
        except FileNotFoundError as error:
            raise CheckpointError(f"{file} cannot be read: {error.strerror}") from None
        except OSError as error:
            raise CheckpointError(f"{file} is corrupt: {error.strerror}") from None
        if len(data) != entry["size"] or hashlib.sha256(data).hexdigest() != entry["sha256"]:
            raise CheckpointError(
                f"{file} is corrupt: it is not what the manifest says ({len(data)} bytes of {entry['size']})",
                hint="choose an older checkpoint with RUN@step:N",
            )
        return data


def save(checkpoints: Path, step: int, state: TrainerState, extra: Mapping[str, Any]) -> Path:
    """Write a checkpoint: into a temporary folder, every file synced, the manifest last, then one rename.

    Args:
        checkpoints: the run's folder of checkpoints.
        step: environment steps.
        state: what the trainer gave.
        extra: further JSON-able entries of the manifest.

    Raises:
        MachineError: if the disk refuses or the folder is gone; nothing half-written is left.
    """
    target = checkpoints / f"{step:012d}"
    if target.exists():
        return target
    temporary = checkpoints / f".tmp-{os.getpid()}-{secrets.token_hex(4)}"
    values = dict(state.values)
    contents: dict[str, bytes] = {"policy.json": to_json(values["policy"]).encode()}
    contents["state.json"] = to_json(values).encode()
    for part in state.tensors:
        tensors = {name: value.detach().contiguous() for name, value in state.tensors[part].items()}
        contents[f"{part}.safetensors"] = safetensors.torch.save(tensors)
    files = {name: {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()} for name, data in contents.items()}
    manifest = {"format": FORMAT, "step": step, **extra, "files": files}
    try:
        temporary.mkdir()
        for name, data in contents.items():
            write_synced(temporary / name, data)
        write_synced(temporary / "manifest.json", to_json(manifest).encode())
        sync_folder(temporary)
        os.rename(temporary, target)
        sync_folder(checkpoints)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        if isinstance(error, OSError):
            raise disk_error(target, error) from error
        raise
    write_atomic(checkpoints / "latest", target.name + "\n")
    return target


def open_checkpoint(folder: Path) -> Checkpoint:
    """Open a checkpoint and check its manifest; the files are checked as they are read.

    Raises:
        CheckpointError: if it is missing, incomplete, corrupt or of another format.
    """
    file = folder / "manifest.json"
    try:
        manifest = _json(read_plain(file, MOST_JSON), file)
    except FileNotFoundError:
        raise CheckpointError(f"{folder} is not a checkpoint: it has no manifest.json") from None
    except OSError as error:
        raise CheckpointError(f"{file} cannot be read: {error.strerror}") from None
    if manifest.get("format") != FORMAT:
        raise CheckpointError(
            f"{folder} has checkpoint format {manifest.get('format')}; this rlcli reads {FORMAT}",
            hint="use the rlcli version that run.json names",
        )
    files = manifest.get("files")
    if not isinstance(files, dict) or not all(
        isinstance(e, dict) and isinstance(e.get("size"), int) and isinstance(e.get("sha256"), str)
        for e in files.values()
    ):
        raise CheckpointError(f"{file} is corrupt: its list of files is malformed")
    if not isinstance(manifest.get("step"), int):
        raise CheckpointError(f"{file} is corrupt: it has no step")
    return Checkpoint(folder, manifest)


def steps(checkpoints: Path) -> list[int]:
    """Steps of the complete checkpoints of a run, ascending."""
    if not checkpoints.is_dir():
        return []
    names = [file.parent.name for file in checkpoints.glob("*/manifest.json")]
    return sorted(int(name) for name in names if name.isdecimal() and name == f"{int(name):012d}")


def drop_after(checkpoints: Path, step: int) -> list[int]:
    """Remove the checkpoints after a step: training goes on from there, and they are no longer its future."""
    later = [have for have in steps(checkpoints) if have > step]
    for have in later:
        shutil.rmtree(checkpoints / f"{have:012d}")
    return later


def clean(checkpoints: Path) -> None:
    """Remove what killed writers left."""
    for leftover in checkpoints.glob(".tmp-*"):
        shutil.rmtree(leftover, ignore_errors=True)
    for file in [*checkpoints.glob(".*.tmp-*"), *checkpoints.parent.glob(".*.tmp-*")]:
        file.unlink(missing_ok=True)


def _json(data: bytes, file: Path) -> dict[str, Any]:
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        raise CheckpointError(f"{file} is corrupt: not JSON") from None
    if not isinstance(value, dict):
        raise CheckpointError(f"{file} is corrupt: not a JSON object")
    return value

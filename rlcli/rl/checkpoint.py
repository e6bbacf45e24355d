"""Reading checkpoints: folders of safetensors and JSON, verified before use, never unpickled."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor

from rlcli.errors import CheckpointError
from rlcli.rl.trainer import Rows, TrainerState

FORMAT = 1
PARTS = ("policy", "trainer", "env", "rng")
"""Tensor files of every checkpoint: the policy alone, critics and optimisers, environment, generators. A trainer may
add parts of its own."""
LOG_FOLDER = "logs"
"""Beside the checkpoints: rows that several of them share, such as a replay buffer's, in files that never change."""


@dataclass(frozen=True, slots=True)
class Shard:
    """A file with some rows of a log."""

    start: int
    stop: int
    size: int
    sha256: str

    @property
    def file(self) -> str:
        """Its name."""
        return f"{self.start:012d}-{self.stop:012d}.safetensors"

    def record(self) -> dict[str, Any]:
        """As plain JSON."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A verified checkpoint folder."""

    folder: Path
    manifest: dict[str, Any]

    @property
    def step(self) -> int:
        """Environment steps at which it was written."""
        return int(self.manifest["step"])

    @property
    def iteration(self) -> int:
        """Iteration after which it was written."""
        return int(self.manifest["iteration"])

    def json(self, name: str) -> dict[str, Any]:
        """A JSON file of the checkpoint."""
        return _json(self._data(name), self.folder / name)

    def tensors(self, part: str) -> dict[str, Tensor]:
        """The tensors of a part.

        Raises:
            CheckpointError: if the file is not what safetensors reads.
        """
        name = f"{part}.safetensors"
        return _tensors(self._data(name), self.folder / name)

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
        return TrainerState(tensors, self.json("state.json"), {name: self._rows(name) for name in self.shards()})

    def shards(self) -> dict[str, list[Shard]]:
        """The files with the rows of each log, oldest first.

        Raises:
            CheckpointError: if the manifest does not say so properly.
        """
        try:
            return {
                str(name): [Shard(**{**entry}) for entry in log["shards"]]
                for name, log in self.manifest.get("logs", {}).items()
            }
        except (AttributeError, KeyError, TypeError):
            raise CheckpointError(f"{self.folder}/manifest.json is corrupt: its list of rows is malformed") from None

    def _rows(self, name: str) -> Rows:
        log, shards = self.manifest["logs"][name], self.shards()[name]
        first, stop = log["first"], log["stop"]
        begins = [shard.start for shard in shards] + [stop]
        if [shard.stop for shard in shards] != begins[1:] or begins[0] > first:
            raise CheckpointError(f"{self.folder}/manifest.json is corrupt: rows of '{name}' are missing")

        def read(start: int, end: int) -> dict[str, Tensor]:
            parts = []
            for shard in shards:
                if shard.start < end and start < shard.stop:
                    file = self.folder.parent / LOG_FOLDER / name / shard.file
                    columns = _tensors(_verified(file, shard.size, shard.sha256), file)
                    rows = slice(max(start, shard.start) - shard.start, min(end, shard.stop) - shard.start)
                    parts.append({column: values[rows] for column, values in columns.items()})
            return {column: torch.cat([part[column] for part in parts]) for column in parts[0]} if parts else {}

        return Rows(first, stop, read)

    def _data(self, name: str) -> bytes:
        entry = self.manifest["files"].get(name)
        if entry is None:
            raise CheckpointError(f"{self.folder} has no {name}")
        return _verified(self.folder / name, entry["size"], entry["sha256"])


def open_checkpoint(folder: Path) -> Checkpoint:
    """Open a checkpoint and check its manifest; the files are checked as they are read.

    Raises:
        CheckpointError: if it is missing, incomplete, corrupt or of another format.
    """
    file = folder / "manifest.json"
    try:
        manifest = _json(file.read_bytes(), file)
    except OSError:
        raise CheckpointError(f"{folder} is not a checkpoint: it has no manifest.json") from None
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


def sha256(data: bytes) -> str:
    """The hash that a manifest keeps of a file."""
    return hashlib.sha256(data).hexdigest()


def _verified(file: Path, size: int, digest: str) -> bytes:
    """The content of a file, if it is what the manifest says."""
    try:
        data = file.read_bytes()
    except OSError as error:
        raise CheckpointError(f"{file} cannot be read: {error.strerror}") from None
    if len(data) != size or sha256(data) != digest:
        raise CheckpointError(
            f"{file} is corrupt: it is not what the manifest says ({len(data)} bytes of {size})",
            hint="choose an older checkpoint with RUN@step:N",
        )
    return data


def _tensors(data: bytes, file: Path) -> dict[str, Tensor]:
    try:
        return safetensors.torch.load(data)
    except (SafetensorError, ValueError, KeyError) as error:
        raise CheckpointError(f"{file} is corrupt: {error}") from None


def _json(data: bytes, file: Path) -> dict[str, Any]:
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        raise CheckpointError(f"{file} is corrupt: not JSON") from None
    if not isinstance(value, dict):
        raise CheckpointError(f"{file} is corrupt: not a JSON object")
    return value

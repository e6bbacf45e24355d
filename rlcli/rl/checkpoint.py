"""Reading checkpoints: folders of safetensors and JSON, verified before use, never unpickled."""

from __future__ import annotations

import hashlib
import math
import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import Tensor

from rlcli.errors import CheckpointError
from rlcli.machine import memory
from rlcli.rl.policy import Policy, blank_policy, filled, size_of
from rlcli.rl.reading import JSON_LIMIT, parse_json, read_file
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
        iteration = self.manifest.get("iteration")
        if not _is_count(iteration):
            raise CheckpointError(f"{self.folder}/manifest.json is corrupt: it has no iteration")
        return int(iteration or 0)

    def json(self, name: str) -> dict[str, Any]:
        """A JSON file of the checkpoint."""
        return parse_json(self._data(name, JSON_LIMIT), self.folder / name)

    def tensors(self, part: str, limit: int | None = None) -> dict[str, Tensor]:
        """The tensors of a part.

        Args:
            part: its name.
            limit: largest size of its file [bytes]; None: what such a part and this machine's memory allow.

        Raises:
            CheckpointError: if the file is larger, or not what safetensors reads.
        """
        name = f"{part}.safetensors"
        if limit is None:
            limit = min(_LIMITS.get(part.partition(".")[0], _UNLIMITED), memory() // 3)
        return _tensors(self._data(name, limit), self.folder / name)

    def policy(self) -> Policy:
        """The policy, ready to act; nothing of the task or the simulator is needed.

        Raises:
            CheckpointError: if it is corrupt.
        """
        try:
            blank = blank_policy(self.json("policy.json"))
            # as many bytes as its description asks for, and a header; a longer file is not even read
            return filled(blank, self.tensors("policy", size_of(blank) + _HEADER_LIMIT))
        except CheckpointError as error:
            if str(self.folder) in error.message:
                raise
            raise CheckpointError(f"{self.folder}: {error.message}", hint=error.hint) from None

    def state(self) -> TrainerState:
        """Everything a trainer goes on from.

        Raises:
            CheckpointError: if something is missing, corrupt, not finite or of a kind that no trainer saves.
        """
        missing = [part for part in PARTS if f"{part}.safetensors" not in self.manifest["files"]]
        if missing:
            raise CheckpointError(
                f"{self.folder} has no {missing[0]}.safetensors", hint="--init-from takes its policy into a new run"
            )
        values = self.json("state.json")
        _require_values(values, self.step, self.folder / "state.json")
        if values["policy"] != self.json("policy.json"):
            raise CheckpointError(f"{self.folder}/state.json is corrupt: its policy is not that of policy.json")
        self.policy()
        parts = [name.removesuffix(".safetensors") for name in self.manifest["files"] if name.endswith(".safetensors")]
        tensors = {part: self.tensors(part) for part in parts}
        seen = tensors["trainer"].get("observations")
        if seen is not None and (seen.dim() != 2 or seen.shape[1] != values["policy"]["observation_size"]):
            raise CheckpointError(f"{self.folder}/trainer.safetensors: 'observations' is {tuple(seen.shape)}")
        for part in ("policy", "trainer"):
            for name, value in tensors[part].items():
                if value.is_floating_point() and not bool(value.isfinite().all()):
                    raise CheckpointError(
                        f"{self.folder / part}.safetensors: '{name}' holds values that are not finite"
                    )
                if name.endswith(("normalizer.var", "normalizer.count")) and bool((value < 0).any()):
                    raise CheckpointError(f"{self.folder / part}.safetensors: '{name}' is negative")
        return TrainerState(tensors, values, {name: self._rows(name) for name in self.shards()})

    def verify(self, *, whole: bool) -> None:
        """Read and check the policy, or everything.

        Raises:
            CheckpointError: at the first thing that is wrong.
        """
        if not whole:
            self.policy()
            return
        for rows in self.state().logs.values():
            for start in range(rows.first, rows.stop, _ROWS_AT_ONCE):
                rows.read(start, min(start + _ROWS_AT_ONCE, rows.stop))

    def shards(self) -> dict[str, list[Shard]]:
        """The files with the rows of each log, oldest first.

        Raises:
            CheckpointError: if the manifest does not say so properly.
        """
        logs = self.manifest.get("logs", {})
        if not _are_logs(logs):
            raise CheckpointError(f"{self.folder}/manifest.json is corrupt: its list of rows is malformed")
        return {name: [Shard(**entry) for entry in log["shards"]] for name, log in logs.items()}

    def _rows(self, name: str) -> Rows:
        log, shards = self.manifest["logs"][name], self.shards()[name]
        first, stop = log["first"], log["stop"]
        begins = [shard.start for shard in shards] + [stop]
        if [shard.stop for shard in shards] != begins[1:] or begins[0] > first:
            raise CheckpointError(f"{self.folder}/manifest.json is corrupt: rows of '{name}' are missing")
        held, most = sum(shard.size for shard in shards), memory() // 3
        if held > most:
            raise CheckpointError(f"{self.folder}: '{name}' has {held:,} bytes; this machine has memory for {most:,}")

        def read(start: int, end: int) -> dict[str, Tensor]:
            parts = []
            for shard in shards:
                if shard.start < end and start < shard.stop:
                    columns = self._shard(name, shard)
                    rows = slice(max(start, shard.start) - shard.start, min(end, shard.stop) - shard.start)
                    parts.append({column: values[rows] for column, values in columns.items()})
            if any(set(part) != set(parts[0]) for part in parts):
                raise CheckpointError(f"{self.folder}/manifest.json: the files of '{name}' do not belong together")
            return {column: torch.cat([part[column] for part in parts]) for column in parts[0]} if parts else {}

        return Rows(first, stop, read)

    def _shard(self, name: str, shard: Shard) -> dict[str, Tensor]:
        file = self.folder.parent / LOG_FOLDER / name / shard.file
        columns = _tensors(_verified(file, shard.size, shard.sha256, min(_MOST_OF_A_SHARD, memory() // 3)), file)
        for column, values in columns.items():
            if values.shape[:1] != (shard.stop - shard.start,):
                raise CheckpointError(f"{file} is corrupt: '{column}' has not the rows of its name")
        return columns

    def _data(self, name: str, limit: int) -> bytes:
        entry = self.manifest["files"].get(name)
        if entry is None:
            raise CheckpointError(f"{self.folder} has no {name}")
        return _verified(self.folder / name, entry["size"], entry["sha256"], limit)


def open_checkpoint(folder: Path) -> Checkpoint:
    """Open a checkpoint and check its manifest; the files are checked as they are read.

    Raises:
        CheckpointError: if it is missing, incomplete, corrupt or of another format.
    """
    file = folder / "manifest.json"
    try:
        manifest = parse_json(read_file(file, JSON_LIMIT), file)
    except FileNotFoundError:
        raise CheckpointError(f"{folder} is not a checkpoint: it has no manifest.json") from None
    if type(manifest.get("format")) is not int or manifest["format"] != FORMAT:
        raise CheckpointError(
            f"{folder} has checkpoint format {str(manifest.get('format'))[:40]}; this rlcli reads {FORMAT}",
            hint="use the rlcli version that run.json names",
        )
    _require_entries(manifest.get("files"), file)
    step = manifest.get("step")
    if not _is_count(step):
        raise CheckpointError(f"{file} is corrupt: it has no step")
    name = folder.name
    if name.isdecimal() and name.isascii() and len(name) >= 12 and int(name) != step:
        raise CheckpointError(f"{file} is corrupt: it is of step {step}, and its folder of step {int(name)}")
    return Checkpoint(folder, manifest)


def steps(checkpoints: Path) -> list[int]:
    """Steps of the complete checkpoints of a run, ascending."""
    if checkpoints.is_symlink() or not checkpoints.is_dir():
        return []
    names = [file.parent.name for file in checkpoints.glob("*/manifest.json") if not file.parent.is_symlink()]
    return sorted(int(name) for name in names if name.isdecimal() and name == f"{int(name):012d}")


def sha256(data: bytes) -> str:
    """The hash that a manifest keeps of a file."""
    return hashlib.sha256(data).hexdigest()


def _verified(file: Path, size: int, digest: str, limit: int) -> bytes:
    """The content of a file, if it is what the manifest says."""
    try:
        data = read_file(file, limit, size=size)
    except FileNotFoundError:
        raise CheckpointError(f"{file} is missing") from None
    if len(data) != size or sha256(data) != digest:
        raise CheckpointError(
            f"{file} is corrupt: it is not what the manifest says ({len(data)} bytes of {size})",
            hint="choose an older checkpoint with RUN@step:N",
        )
    return data


def _tensors(data: bytes, file: Path) -> dict[str, Tensor]:
    _require_header(data, file)
    try:
        return safetensors.torch.load(data)
    except (SafetensorError, RuntimeError, ValueError, KeyError, MemoryError) as error:
        raise CheckpointError(f"{file} is corrupt: {' '.join(str(error).split())}") from None


_FILE = re.compile(r"[a-z][a-z0-9_]{0,63}(\.[0-9]{1,6})?\.(json|safetensors)", re.ASCII)
_LOG = re.compile(r"[a-z][a-z0-9_]{0,63}", re.ASCII)
_MOST_FILES = 4096
_ROWS_AT_ONCE = 1000
_MOST_OF_A_SHARD = 2**30
_HEADER_LIMIT = 4 * 2**20
_MOST_TENSORS = 20_000
_MOST_DIMENSIONS = 16
_LIMITS = {"policy": 2 * 2**30, "trainer": 16 * 2**30, "env": 16 * 2**30, "rng": 2**20}
"""Part -> largest size of its file [bytes]."""
_UNLIMITED = 2**62
_MOST_STEPS = 2**62


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < _MOST_STEPS


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _require_entries(files: Any, file: Path) -> None:
    """The manifest's list of files: plain names, sizes and digests."""
    good = isinstance(files, dict) and all(
        isinstance(entry, dict)
        and _is_count(entry.get("size"))
        and isinstance(entry.get("sha256"), str)
        and len(entry["sha256"]) <= 64
        for entry in files.values()
    )
    if not good:
        raise CheckpointError(f"{file} is corrupt: its list of files is malformed")
    if len(files) > _MOST_FILES:
        raise CheckpointError(f"{file} is corrupt: it lists {len(files)} files")
    for name in files:
        if not _FILE.fullmatch(name):
            raise CheckpointError(f"{file} is corrupt: {name[:80]!r} is no name of a file of a checkpoint")


def _are_logs(logs: Any) -> bool:
    """Names of folders, counts of rows, and files with some of them."""
    return isinstance(logs, dict) and all(
        _LOG.fullmatch(name)
        and isinstance(log, dict)
        and _is_count(log.get("first"))
        and _is_count(log.get("stop"))
        and log["first"] <= log["stop"]
        and isinstance(log.get("shards"), list)
        and len(log["shards"]) <= _MOST_FILES
        and all(map(_is_shard, log["shards"]))
        for name, log in logs.items()
    )


def _is_shard(entry: Any) -> bool:
    return (
        isinstance(entry, dict)
        and set(entry) == {"start", "stop", "size", "sha256"}
        and all(_is_count(entry[key]) for key in ("start", "stop", "size"))
        and entry["start"] < entry["stop"]
        and isinstance(entry["sha256"], str)
        and len(entry["sha256"]) == 64
    )


def _require_header(data: bytes, file: Path) -> None:
    """What the file says of its tensors must be of a size that torch takes; whether it is true, safetensors checks."""
    length = int.from_bytes(data[:8], "little")
    if length > min(_HEADER_LIMIT, len(data) - 8):
        raise CheckpointError(f"{file} is corrupt: it is no safetensors file, or its header is too long")
    header = parse_json(data[8 : 8 + length], file)
    if len(header) > _MOST_TENSORS:
        raise CheckpointError(f"{file} is corrupt: it lists {len(header)} tensors")
    for name, entry in header.items():
        shape = entry.get("shape", []) if isinstance(entry, dict) else None
        if not isinstance(shape, list) or len(shape) > _MOST_DIMENSIONS or not all(map(_is_count, shape)):
            raise CheckpointError(f"{file} is corrupt: the shape of '{name[:80]}' makes no sense")


def _require_values(values: dict[str, Any], step: int, file: Path) -> None:
    """What every trainer keeps besides tensors; what only one of them keeps, it checks itself."""
    for key in ("iteration", "env_steps", "updates", "processes", "rnd_updates"):
        if key in values and not _is_count(values[key]):
            raise CheckpointError(f"{file} is corrupt: {key} is {_shown(values[key])}, expected a count")
    if values.get("env_steps", step) != step:
        raise CheckpointError(f"{file} is corrupt: it is of step {values['env_steps']}, and the manifest of {step}")
    if "learning_rate" in values and not (_is_number(values["learning_rate"]) and 0 <= values["learning_rate"] < 1e6):
        raise CheckpointError(f"{file} is corrupt: learning_rate is {_shown(values['learning_rate'])}")
    if not isinstance(values.get("policy"), dict):
        raise CheckpointError(f"{file} is corrupt: it does not describe the policy")
    for key, entry in values.items():
        if key.partition(".")[0] == "statistics" and not _are_statistics(entry):
            raise CheckpointError(f"{file} is corrupt: {key} makes no sense")


def _are_statistics(entry: Any) -> bool:
    if not isinstance(entry, dict) or set(entry) != {"recent", "total"} or not _is_count(entry["total"]):
        return False
    rows = entry["recent"]
    return isinstance(rows, list) and all(
        isinstance(row, list) and len(row) == 4 and all(map(_is_number, row)) and row[0] > 0 for row in rows
    )


def _shown(value: Any) -> str:
    return repr(value)[:40]

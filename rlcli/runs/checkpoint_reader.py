"""Read checkpoints, which are folders of safetensors and JSON files, and check their files.

A checkpoint may be untrusted: sizes and hashes are checked, and nothing is unpickled.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Self

import safetensors.torch
import torch
from pydantic import ConfigDict, Field, RootModel, model_validator
from safetensors import SafetensorError
from torch import Tensor

from rlcli.errors import CheckpointError
from rlcli.machine.memory import available_memory
from rlcli.rl.policy import Policy, blank_policy, filled, size_of
from rlcli.rl.trainer import Rows, TrainerState
from rlcli.runs.safe_io import JSON_LIMIT, Count, FileModel, check_json, manifest_error, parse_json, read_file

FORMAT = 1
PARTS = ("policy", "trainer", "env", "rng")
"""Tensor files PART.safetensors of every checkpoint. policy: the policy; trainer: critics and optimisers; env: state of
the environments; rng: random generators. A trainer may add parts."""
LOG_FOLDER = "logs"
"""Folder beside the checkpoints with data in rows that several checkpoints share, such as the rows of a replay buffer.
Such data is called a log. Files in the folder never change."""
_ROWS_AT_ONCE = 1000
_MAX_SHARD_BYTES = 2**30
_HEADER_LIMIT = 4 * 2**20
_LIMITS = {"policy": 2 * 2**30, "trainer": 16 * 2**30, "env": 16 * 2**30, "rng": 2**20}
"""Part -> largest size of its file [bytes]."""
_UNLIMITED = 2**62

_NAME = r"^[a-z][a-z0-9_]{0,63}"
FileName = Annotated[str, Field(pattern=_NAME + r"(\.[0-9]{1,6})?\.(json|safetensors)$")]
LogName = Annotated[str, Field(pattern=_NAME + "$")]
_MAX_FILES = 4096


class FormatError(CheckpointError):
    """Error for a checkpoint in a format that this rlcli does not read, such as that of a newer rlcli."""


class FileEntry(FileModel):
    """Entry of manifest.json for one file of the checkpoint: its size [bytes] and its sha256."""

    size: Count
    sha256: Annotated[str, Field(max_length=64)]


class Shard(FileModel):
    """Entry of manifest.json for one file of a log, which is data in rows, such as a replay buffer.

    A log is split into several files (shards); this one has the rows `start` to `stop` - 1.
    """

    model_config = ConfigDict(extra="forbid")

    start: Count
    stop: Count
    size: Count
    sha256: Annotated[str, Field(min_length=64, max_length=64)]

    @model_validator(mode="after")
    def _check_not_empty(self) -> Self:
        if self.start >= self.stop:
            raise ValueError(
                f"the manifest is damaged: start ({self.start}) is not below stop ({self.stop}); use an older"
                " checkpoint: RUN@step:N"
            )
        return self

    @property
    def file(self) -> str:
        """Name of the file, `START-STOP.safetensors`."""
        return f"{self.start:012d}-{self.stop:012d}.safetensors"


class _Log(FileModel):
    """Entry of manifest.json for a log (data in rows, such as a replay buffer).

    The checkpoint needs the rows `first` to `stop` - 1; the files `shards` hold them.
    """

    first: Count
    stop: Count
    shards: Annotated[list[Shard], Field(max_length=_MAX_FILES)]

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.first > self.stop:
            raise ValueError(
                f"the manifest is damaged: first ({self.first}) is above stop ({self.stop}); use an older checkpoint:"
                " RUN@step:N"
            )
        return self


class _Manifest(FileModel):
    """The entries of manifest.json that every use of a checkpoint needs."""

    step: Count
    files: Annotated[dict[FileName, FileEntry], Field(max_length=_MAX_FILES)]


class _Iteration(FileModel):
    iteration: Count


class _Logs(FileModel):
    logs: dict[LogName, _Log] = Field(default_factory=dict)


class _TensorEntry(FileModel):
    """Shape of a tensor in the header of a safetensors file; the safetensors library checks the rest."""

    shape: list[Count] = Field(default_factory=list, max_length=16)


class _Header(RootModel[Annotated[dict[str, _TensorEntry], Field(max_length=20_000)]]):
    """Header of a safetensors file: the shape of each tensor, by name."""


class _State(FileModel):
    """Values of state.json that several trainers save; a trainer checks the other values itself."""

    iteration: Count = 0
    env_steps: Count = 0
    updates: Count = 0
    processes: Count = 0
    rnd_updates: Count = 0
    learning_rate: Annotated[float, Field(ge=0, lt=1e6)] = 0.0
    policy: dict[str, Any]


class _Statistics(FileModel):
    """Statistics of finished episodes in state.json.

    `recent` has a row (episodes, sum of returns, sum of lengths, successes) for each recent iteration.
    """

    model_config = ConfigDict(extra="forbid")

    recent: list[tuple[Annotated[float, Field(gt=0)], float, float, float]]
    total: Count


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A checkpoint: a folder with the files of a training at one step. Each file is checked when it is read."""

    folder: Path
    manifest: dict[str, Any]
    """Content of manifest.json, which lists the files with their sizes and hashes."""

    @property
    def step(self) -> int:
        """Environment steps of the training when the checkpoint was written."""
        return int(self.manifest["step"])

    @property
    def iteration(self) -> int:
        """Index of the last finished iteration when the checkpoint was written."""
        return check_json(_Iteration, self.manifest, self.folder / "manifest.json").iteration

    def json(self, name: str) -> dict[str, Any]:
        """Return the content of a JSON file of the checkpoint, such as `policy.json`, after a check of its hash.

        Raises:
            CheckpointError: if the file is missing or corrupt.
        """
        return parse_json(self._data(name, JSON_LIMIT), self.folder / name)

    def tensors(self, part: str, limit: int | None = None) -> dict[str, Tensor]:
        """Read the tensors of the file PART.safetensors of the checkpoint.

        Args:
            part: the name of the part, such as `policy` or `trainer`.
            limit: largest size of the file [bytes]; None: the default of the part, at most a third of the memory.

        Raises:
            CheckpointError: if the file is missing, larger than the limit, or corrupt.
        """
        name = f"{part}.safetensors"
        if limit is None:
            limit = min(_LIMITS.get(part.partition(".")[0], _UNLIMITED), available_memory() // 3)
        return _tensors(self._data(name, limit), self.folder / name)

    def policy(self) -> Policy:
        """Load the policy; neither the task nor the simulator is needed.

        Raises:
            CheckpointError: if the policy is corrupt.
        """
        try:
            blank = blank_policy(self.json("policy.json"))
            # the size follows from policy.json; a larger file is refused before it is read
            return filled(blank, self.tensors("policy", size_of(blank) + _HEADER_LIMIT))
        except CheckpointError as error:
            if str(self.folder) in error.message:
                raise
            raise CheckpointError(f"{self.folder}: {error.message}", hint=error.hint) from None

    def state(self) -> TrainerState:
        """Load everything that a trainer needs to resume.

        Raises:
            CheckpointError: if an entry is missing, corrupt, not finite, or of a type that no trainer saves.
        """
        missing = [part for part in PARTS if f"{part}.safetensors" not in self.manifest["files"]]
        if missing:
            message = f"{self.folder} cannot be resumed: it has no {missing[0]}.safetensors"
            raise CheckpointError(message, hint="use --init-from to start a new run with the policy of the checkpoint")
        values = self.json("state.json")
        _check_state(values, self.step, self.folder / "state.json")
        if values["policy"] != self.json("policy.json"):
            raise CheckpointError(
                f"{self.folder} is corrupt: state.json and policy.json have different policies"
                "; use an older checkpoint: RUN@step:N"
            )
        self.policy()
        parts = [name.removesuffix(".safetensors") for name in self.manifest["files"] if name.endswith(".safetensors")]
        tensors = {part: self.tensors(part) for part in parts}
        obs = tensors["trainer"].get("observations")
        if obs is not None and (obs.dim() != 2 or obs.shape[1] != values["policy"]["observation_size"]):
            raise CheckpointError(
                f"{self.folder}: 'observations' has wrong shape {tuple(obs.shape)}; use an older checkpoint: RUN@step:N"
            )
        file = self.folder / "trainer.safetensors"  # `self.policy()` has checked the tensors of the policy
        for name, value in tensors["trainer"].items():
            if value.is_floating_point() and not bool(value.isfinite().all()):
                raise CheckpointError(f"{file}: '{name}' is not finite; use an older checkpoint: RUN@step:N")
            if name.endswith(("normalizer.var", "normalizer.count")) and bool((value < 0).any()):
                raise CheckpointError(f"{file}: '{name}' is negative; use an older checkpoint: RUN@step:N")
        return TrainerState(tensors, values, {name: self._rows(name) for name in self.shards()})

    def verify(self, *, whole: bool) -> None:
        """Read and check the policy; if `whole`, also everything else that is needed to resume the training.

        Raises:
            CheckpointError: if a file is missing or corrupt.
        """
        if not whole:
            self.policy()
            return
        for rows in self.state().logs.values():
            for start in range(rows.first, rows.stop, _ROWS_AT_ONCE):
                rows.read(start, min(start + _ROWS_AT_ONCE, rows.stop))

    def shards(self) -> dict[str, list[Shard]]:
        """Return the files of each log (data in rows, such as a replay buffer), the file with the oldest rows first.

        Raises:
            CheckpointError: if the manifest's entry `logs` is malformed.
        """
        return {name: log.shards for name, log in self._logs().items()}

    def _logs(self) -> dict[str, _Log]:
        return check_json(_Logs, self.manifest, self.folder / "manifest.json").logs

    def _rows(self, name: str) -> Rows:
        log = self._logs()[name]
        first, stop, shards = log.first, log.stop, log.shards
        starts = [shard.start for shard in shards] + [stop]
        if [shard.stop for shard in shards] != starts[1:] or starts[0] > first:
            raise CheckpointError(
                f"{self.folder}/manifest.json is corrupt: rows of '{name}' are missing; use an older checkpoint:"
                " RUN@step:N"
            )
        size, limit = sum(shard.size for shard in shards), available_memory() // 3
        if size > limit:
            raise CheckpointError(
                f"{self.folder}: '{name}' needs {size:,} bytes of memory; rlcli uses at most {limit:,},"
                " a third of the free memory; end other programs"
            )

        def read(start: int, end: int) -> dict[str, Tensor]:
            parts = []
            for shard in shards:
                if shard.start < end and start < shard.stop:
                    columns = self._shard(name, shard)
                    rows = slice(max(start, shard.start) - shard.start, min(end, shard.stop) - shard.start)
                    parts.append({column: values[rows] for column, values in columns.items()})
            if any(set(part) != set(parts[0]) for part in parts):
                raise CheckpointError(
                    f"{self.folder} is corrupt: the parts of '{name}' have different columns"
                    "; use an older checkpoint: RUN@step:N"
                )
            return {column: torch.cat([part[column] for part in parts]) for column in parts[0]} if parts else {}

        return Rows(first, stop, read)

    def _shard(self, name: str, shard: Shard) -> dict[str, Tensor]:
        file = self.folder.parent / LOG_FOLDER / name / shard.file
        data = _verified(file, shard.size, shard.sha256, min(_MAX_SHARD_BYTES, available_memory() // 3))
        columns = _tensors(data, file)
        for column, values in columns.items():
            if values.shape[:1] != (shard.stop - shard.start,):
                raise CheckpointError(
                    f"{file} is corrupt: rows of '{column}' are missing; use an older checkpoint: RUN@step:N"
                )
        return columns

    def _data(self, name: str, limit: int) -> bytes:
        entry = self.manifest["files"].get(name)
        if entry is None:
            raise CheckpointError(f"{self.folder} has no {name}; choose an older checkpoint: RUN@step:N")
        return _verified(self.folder / name, entry["size"], entry["sha256"], limit)


def open_checkpoint(folder: Path) -> Checkpoint:
    """Open a checkpoint and check its manifest; each file is checked when it is read.

    Raises:
        CheckpointError: if the checkpoint is missing, incomplete or corrupt.
        FormatError: if the checkpoint has a format that this rlcli does not read.
    """
    file = folder / "manifest.json"
    data = read_file(file, JSON_LIMIT, missing=f"{folder} is not a checkpoint: it has no manifest.json; check the path")
    manifest = parse_json(data, file)
    if type(manifest.get("format")) is not int or manifest["format"] != FORMAT:
        message = f"{folder} has checkpoint format {str(manifest.get('format'))[:40]}; this rlcli reads {FORMAT}"
        hint = "install the version of rlcli that wrote the checkpoint; run.json or manifest.json names the version"
        raise FormatError(message, hint=hint)
    step = check_json(_Manifest, manifest, file).step
    name = folder.name
    if name.isdecimal() and name.isascii() and len(name) >= 12 and int(name) != step:
        raise CheckpointError(
            f"{file} has step {step}, but its folder is named {name}; rename the folder to {step:012d}"
        )
    return Checkpoint(folder, manifest)


def steps(checkpoints: Path) -> list[int]:
    """Return the environment steps of the checkpoints in a run's folder `checkpoints`, ascending.

    The steps are read from the names of the folders, 12 digits each; links and other names are ignored.
    """
    if checkpoints.is_symlink() or not checkpoints.is_dir():
        return []
    names = [entry.name for entry in checkpoints.iterdir() if not entry.is_symlink()]
    return sorted(int(name) for name in names if name.isdecimal() and name == f"{int(name):012d}")


def sha256(data: bytes) -> str:
    """Return the SHA-256 of a file's content, as manifest.json stores it."""
    return hashlib.sha256(data).hexdigest()


def _verified(file: Path, size: int, digest: str, limit: int) -> bytes:
    """Return the content of a file after a check of its size [bytes] and its SHA-256 (`digest`) in manifest.json.

    Raises:
        CheckpointError: if the file differs from the manifest, or has more than `limit` bytes.
    """
    data = read_file(file, limit, size=size, missing=f"{file} is missing; choose an older checkpoint: RUN@step:N")
    if len(data) != size:
        raise manifest_error(file, f"{len(data)} bytes were read, but the manifest has {size}")
    if sha256(data) != digest:
        raise manifest_error(file, "its hash differs from the hash in the manifest")
    return data


def _tensors(data: bytes, file: Path) -> dict[str, Tensor]:
    """Return the tensors of a safetensors file after a check of its header."""
    length = int.from_bytes(data[:8], "little")
    if length > min(_HEADER_LIMIT, len(data) - 8):
        raise CheckpointError(f"{file} is corrupt: not a safetensors file; use an older checkpoint: RUN@step:N")
    check_json(_Header, parse_json(data[8 : 8 + length], file), file)  # the check ensures shapes that torch accepts
    try:
        return safetensors.torch.load(data)
    except (SafetensorError, RuntimeError, ValueError, KeyError, MemoryError) as error:
        raise CheckpointError(
            f"{file} is corrupt: {' '.join(str(error).split())}; use an older checkpoint: RUN@step:N"
        ) from None


def _check_state(values: dict[str, Any], step: int, file: Path) -> None:
    """Check the values of state.json that several trainers save. `step` is the step in manifest.json.

    Raises:
        CheckpointError: if a value is malformed, or the steps differ.
    """
    check_json(_State, values, file)
    if values.get("env_steps", step) != step:
        found = values["env_steps"]
        raise CheckpointError(
            f"{file} is corrupt: its step is {found}, but manifest.json has step {step};"
            " use another checkpoint: RUN@step:N"
        )
    for key, entry in values.items():
        if key.partition(".")[0] == "statistics":
            check_json(_Statistics, entry, file, key)

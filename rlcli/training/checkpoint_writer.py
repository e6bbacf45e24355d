"""Writer of checkpoints: in the background, each one complete or absent, and old ones removed."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import shutil
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors.torch
from torch import Tensor

from rlcli.errors import CheckpointError
from rlcli.replay.failure_cases import FOLDER
from rlcli.replay.failure_recorder import FailureBatch, FailureRecorder
from rlcli.rl.trainer import Rows, TrainerState
from rlcli.runs.atomic_io import disk_error, sync_folder, to_json, write_atomic, write_synced
from rlcli.runs.checkpoint import FORMAT, LOG_FOLDER, Checkpoint, Shard, open_checkpoint, sha256, steps

_SHARD_BYTES = 64 << 20
_CLOCKED = 10
"""Checkpoints kept by default if the time decides when to save."""


@dataclass(frozen=True, slots=True)
class Keep:
    """Which checkpoints stay: the first, the best and the newest always do."""

    last: int | None = None
    """How many of the newest; None: all."""
    every: int | None = None
    """Those of every k-th iteration as well."""

    @staticmethod
    def of(last: int | None, every: int | None, save_interval: int | None) -> Keep:
        """Return the agent's choice: without a number, all checkpoints at `save_interval` stay, else the newest few."""
        return Keep(_CLOCKED if last is None and save_interval is None else last, every)


class CheckpointWriter:
    """Writer of a run's checkpoints in a background thread: training waits only for the copies in memory.

    Args:
        checkpoints: the run's folder of checkpoints.
        keep: which of them stay.
        manifest: further JSON-able entries of every manifest.
        resumed: the checkpoint that training goes on from; rows of logs that it has are not written again.
        cases: keeps ends of episodes, which are written with each checkpoint.
    """

    def __init__(
        self,
        checkpoints: Path,
        keep: Keep,
        manifest: Mapping[str, Any],
        *,
        resumed: Checkpoint | None = None,
        cases: FailureRecorder | None = None,
    ) -> None:
        self.checkpoints, self.cases = checkpoints, cases
        self.best: int | None = None
        """Environment steps of the checkpoint with the best evaluation."""
        self.newest: tuple[int, int] | None = None if resumed is None else (resumed.iteration, resumed.step)
        """Iteration and environment steps of the newest checkpoint, which may still be being written."""
        self.written = self.newest
        """Iteration and environment steps of the newest checkpoint on the disk."""
        self._keep, self._manifest = keep, dict(manifest)
        self._shards: dict[str, list[Shard]] = {} if resumed is None else dict(resumed.shards())
        self._copied = {name: shards[-1].stop for name, shards in self._shards.items() if shards}
        self._thread: threading.Thread | None = None
        self._failure: BaseException | None = None

    def is_due(self, iteration: int, save_interval: int | None) -> bool:
        """Return whether a checkpoint is due after this iteration."""
        return any(every and iteration % every == 0 for every in (save_interval, self._keep.every))

    def save(self, state: TrainerState, iteration: int, step: int) -> None:
        """Copy the new rows, and write the checkpoint in the background after the one that is being written.

        Raises:
            MachineError: if the disk refused the checkpoint before, or the folder is gone.
        """
        self.wait()  # the thread notes which rows are written
        fresh = {name: self._copy_new(name, rows) for name, rows in state.logs.items()}
        self.newest = (iteration, step)
        arguments = (state, fresh, iteration, step, None if self.cases is None else self.cases.take(step))
        self._thread = threading.Thread(target=self._write, args=arguments, name="checkpoint", daemon=True)
        self._thread.start()

    def save_cases(self, iteration: int, step: int) -> None:
        """Write the recorded episodes of an iteration that failed: no checkpoint comes after it."""
        if self.cases is not None:
            self.cases.commit(iteration, step)
            batch = self.cases.take(step)
            self.cases.write(batch)
            self.cases.drop(batch)

    def wait(self) -> None:
        """Block until everything is on the disk.

        Raises:
            MachineError: if the disk refused.
        """
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure

    def check(self) -> None:
        """Raise the error of the background thread, if there was one."""
        if self._failure is not None:
            self.wait()

    def _copy_new(self, name: str, rows: Rows) -> list[tuple[int, int, dict[str, Tensor]]]:
        start = max(rows.first, self._copied.get(name, 0))
        if start >= rows.stop:
            return []
        self._copied[name] = rows.stop
        one = rows.read(start, start + 1)
        count = max(1, _SHARD_BYTES // max(1, sum(value.nbytes for value in one.values())))
        parts = [(at, min(at + count, rows.stop)) for at in range(start, rows.stop, count)]
        return [(*part, rows.read(*part)) for part in parts]

    def _write(
        self,
        state: TrainerState,
        fresh: Mapping[str, list[tuple[int, int, dict[str, Tensor]]]],
        iteration: int,
        step: int,
        batch: FailureBatch | None,
    ) -> None:
        try:
            if self.cases is not None and batch is not None:
                self.cases.write(batch)  # before the checkpoint: what is there too early is removed on resuming
            logs = {name: self._write_rows(name, state.logs[name], parts) for name, parts in fresh.items()}
            extra = {**self._manifest, "iteration": iteration, **({"logs": logs} if logs else {})}
            write_checkpoint(self.checkpoints, step, state, extra)
            self.written = (iteration, step)
            if self.cases is not None and batch is not None:
                self.cases.drop(batch)
            prune(self.checkpoints, self._keep, self.best)
        except BaseException as error:
            self._failure = error

    def _write_rows(self, name: str, rows: Rows, parts: list[tuple[int, int, dict[str, Tensor]]]) -> dict[str, Any]:
        folder = self.checkpoints / LOG_FOLDER / name
        shards = self._shards.setdefault(name, [])
        for start, stop, columns in parts:
            data = safetensors.torch.save({column: value.contiguous() for column, value in columns.items()})
            shard = Shard(start=start, stop=stop, size=len(data), sha256=sha256(data))
            try:
                for own in (folder.parent, folder):  # not what they lie in: a run that has vanished is not made again
                    own.mkdir(exist_ok=True)
            except OSError as error:
                raise disk_error(folder, error) from error
            write_atomic(folder / shard.file, data)
            shards.append(shard)
        if parts:
            sync_folder(folder)
        shards[:] = [shard for shard in shards if shard.stop > rows.first]
        return {"first": rows.first, "stop": rows.stop, "shards": [shard.model_dump() for shard in shards]}


def write_checkpoint(checkpoints: Path, step: int, state: TrainerState, extra: Mapping[str, Any]) -> Path:
    """Write one checkpoint: into a temporary folder, every file synced, the manifest last, then one rename.

    Args:
        checkpoints: the run's folder of checkpoints.
        step: environment steps.
        state: the trainer's state.
        extra: further JSON-able entries of the manifest.

    Raises:
        MachineError: if the disk refuses or the folder is gone; nothing half-written is left.
    """
    target = checkpoints / f"{step:012d}"
    if target.exists():
        return target
    temporary = checkpoints / f".tmp-{os.getpid()}-{secrets.token_hex(4)}"
    files: dict[str, dict[str, Any]] = {}

    def put(name: str, data: bytes) -> None:
        write_synced(temporary / name, data)
        files[name] = {"size": len(data), "sha256": sha256(data)}

    try:
        temporary.mkdir()
        put("policy.json", to_json(state.values["policy"]).encode())
        put("state.json", to_json(state.values).encode())
        for part, values_of in state.tensors.items():
            tensors = {name: value.detach().contiguous() for name, value in values_of.items()}
            put(f"{part}.safetensors", safetensors.torch.save(tensors))
        manifest = {"format": FORMAT, "step": step, **extra, "files": files}
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


def prune(checkpoints: Path, keep: Keep, best: int | None) -> None:
    """Remove the checkpoints that need not be kept, and rows of logs that no other checkpoint needs.

    A checkpoint is removed by one rename. Checkpoints that cannot be removed stay.
    """
    have = steps(checkpoints)
    if keep.last is None or len(have) <= keep.last + 1:
        return
    for step in have[1 : -keep.last]:
        folder = checkpoints / f"{step:012d}"
        if step == best or (keep.every and _iteration(folder) % keep.every == 0):
            continue
        _remove(folder)
    drop_rows(checkpoints)


def drop_after(checkpoints: Path, step: int) -> list[int]:
    """Remove the checkpoints after the step from which training is resumed; return their steps."""
    later = [have for have in steps(checkpoints) if have > step]
    for have in reversed(later):
        _remove(checkpoints / f"{have:012d}")
    latest = checkpoints / "latest"
    if (
        later or not latest.is_file() or latest.read_bytes() != f"{step:012d}\n".encode()
    ):  # or the run was killed before it wrote the file
        write_atomic(latest, f"{step:012d}\n")
    drop_rows(checkpoints)
    return later


def drop_rows(checkpoints: Path) -> None:
    """Remove the rows of logs that no checkpoint needs."""
    files = set((checkpoints / LOG_FOLDER).glob("*/*.safetensors"))
    if not files:
        return
    try:
        for step in steps(checkpoints):
            for name, shards in open_checkpoint(checkpoints / f"{step:012d}").shards().items():
                files -= {checkpoints / LOG_FOLDER / name / shard.file for shard in shards}
    except CheckpointError:
        return  # the rows that a damaged checkpoint needs are unknown
    for file in files:
        with contextlib.suppress(OSError):
            file.unlink(missing_ok=True)


def remove_temporary_files(checkpoints: Path) -> None:
    """Remove the temporary files of killed writers."""
    for leftover in checkpoints.glob(".tmp-*"):
        shutil.rmtree(leftover, ignore_errors=True)
    run = checkpoints.parent
    for folder in (checkpoints, run, run / "tb", run / FOLDER, *(checkpoints / LOG_FOLDER).glob("*")):
        for file in folder.glob(".*.tmp-*"):
            file.unlink(missing_ok=True)


def _remove(folder: Path) -> None:
    """Rename a checkpoint to a temporary folder, then delete that."""
    aside = folder.with_name(f".tmp-{os.getpid()}-{secrets.token_hex(4)}")
    try:
        folder.rename(aside)
    except OSError:
        return
    shutil.rmtree(aside, ignore_errors=True)


def _iteration(folder: Path) -> int:
    try:
        return int(json.loads((folder / "manifest.json").read_bytes())["iteration"])
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return 0  # a multiple of every interval: the checkpoint stays

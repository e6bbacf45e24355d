"""Write checkpoints in a background thread, each completely or not at all, and remove old checkpoints.

A "log" in this module is data of a trainer that only grows, such as a replay buffer. Its rows are written once, into
files that all checkpoints share.
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import shutil
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from rlcli.envs.layout import Layout
from rlcli.errors import CheckpointError, MachineError
from rlcli.replay.failure_cases import FOLDER
from rlcli.replay.failure_recorder import FailureBatch, FailureRecorder
from rlcli.rl.trainer import Rows, TrainerState
from rlcli.runs.atomic_io import disk_errors, require_lock, sync_folder, to_json, write_atomic, write_synced
from rlcli.runs.checkpoint_reader import FORMAT, LOG_FOLDER, Checkpoint, Shard, open_checkpoint, sha256, steps
from rlcli.runs.run import Run
from rlcli.runs.tensor_bytes import tensor_bytes

_log = logging.getLogger(__name__)
_SHARD_BYTES = 64 << 20
"""Largest size of a file with rows of a log, such as a replay buffer [bytes]."""
_DEFAULT_LAST = 10
"""Number of newest checkpoints to keep by default if checkpoints are saved by time, without a `save_interval`."""

_NewRows = list[tuple[int, int, dict[str, Tensor]]]
"""Rows of a log (data such as a replay buffer) that must be written: (start, stop, columns) for each new file."""


@dataclass(frozen=True, slots=True)
class KeepRule:
    """Rule for the checkpoints of a run to keep; the first, the best and the newest checkpoint are always kept."""

    last: int | None = None
    """Number of newest checkpoints to keep; None: all."""
    every: int | None = None
    """Also keep the checkpoint of every `every`-th iteration; None: no further checkpoints."""

    @staticmethod
    def from_settings(last: int | None, every: int | None, save_interval: int | None) -> KeepRule:
        """Return the rule for the agent's `keep_last`, `keep_every` and `save_interval`.

        Without `last`, all checkpoints are kept if there is a `save_interval`, else the newest 10.
        """
        return KeepRule(_DEFAULT_LAST if last is None and save_interval is None else last, every)


class CheckpointWriter:
    """Writer of a run's checkpoints in a background thread, while the training goes on.

    The training waits only while the state is copied in memory, and for a previous checkpoint that is not written yet.

    Args:
        checkpoints: the run's folder of checkpoints.
        keep: rule for the checkpoints to keep.
        manifest: entries of `manifest.json` that all checkpoints of the run share.
        resumed: checkpoint from which training continues, whose rows of logs are not written again; None: a new run.
        cases: recorder of failed episodes, which are written with each checkpoint; None: they are not recorded.
    """

    def __init__(
        self,
        checkpoints: Path,
        keep: KeepRule,
        manifest: Mapping[str, Any],
        *,
        resumed: Checkpoint | None = None,
        cases: FailureRecorder | None = None,
    ) -> None:
        self.checkpoints, self.cases = checkpoints, cases
        self.best: int | None = None
        """Environment steps of the checkpoint with the best evaluation; None: no evaluation yet."""
        self.newest: tuple[int, int] | None = None if resumed is None else (resumed.iteration, resumed.step)
        """Iteration and environment steps of the newest checkpoint; the background thread may still be writing it."""
        self.written = self.newest
        """Iteration and environment steps of the newest checkpoint on the disk."""
        self._keep, self._manifest = keep, dict(manifest)
        self._shards: dict[str, list[Shard]] = {} if resumed is None else dict(resumed.shards())
        self._copied = {name: shards[-1].stop for name, shards in self._shards.items() if shards}
        self._thread: threading.Thread | None = None
        self._failure: BaseException | None = None

    def is_due(self, iteration: int, save_interval: int | None) -> bool:
        """Return whether a checkpoint is due after an iteration, by `save_interval` or the rule's `every`."""
        return any(every and iteration % every == 0 for every in (save_interval, self._keep.every))

    def save(self, state: TrainerState, iteration: int, step: int) -> None:
        """Wait for the previous checkpoint, copy the state, and write the new checkpoint in the background.

        Raises:
            MachineError: if the previous checkpoint could not be written, or the lock of the run is lost.
        """
        self.wait()  # first: the thread changes the list of written rows
        fresh = {name: self._copy_new(name, rows) for name, rows in state.logs.items()}
        self.newest = (iteration, step)
        arguments = (state, fresh, iteration, step, None if self.cases is None else self.cases.take(step))
        self._thread = threading.Thread(target=self._write, args=arguments, name="checkpoint", daemon=True)
        self._thread.start()

    def save_cases(self, iteration: int, step: int) -> None:
        """Write the failed episodes of an iteration that ended with a divergence, and so gets no checkpoint."""
        if self.cases is not None:
            self.cases.commit(iteration, step)
            batch = self.cases.take(step)
            self.cases.write(batch)
            self.cases.drop(batch)

    def wait(self) -> None:
        """Block until the last checkpoint is on the disk.

        Raises:
            MachineError: if the checkpoint could not be written, or this process has lost the lock of the run.
        """
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._failure is not None:
            failure, self._failure = self._failure, None
            raise failure
        require_lock(self.checkpoints)

    def check(self) -> None:
        """Raise the error of the background thread, if it had one; do not wait for the thread."""
        if self._failure is not None:
            self.wait()

    def _copy_new(self, name: str, rows: Rows) -> _NewRows:
        """Return copies of those rows of a log that no file contains yet: (start, stop, columns) for each new file."""
        start = max(rows.first, self._copied.get(name, 0))
        if start >= rows.stop:
            return []
        self._copied[name] = rows.stop
        row = rows.read(start, start + 1)
        count = max(1, _SHARD_BYTES // max(1, sum(value.nbytes for value in row.values())))
        parts = [(at, min(at + count, rows.stop)) for at in range(start, rows.stop, count)]
        return [(*part, rows.read(*part)) for part in parts]

    def _write(
        self, state: TrainerState, fresh: Mapping[str, _NewRows], iteration: int, step: int, batch: FailureBatch | None
    ) -> None:
        try:
            if self.cases is not None and batch is not None:
                self.cases.write(batch)  # before the checkpoint: a resumed run removes episodes without a checkpoint
            logs = {name: self._write_rows(name, state.logs[name], parts) for name, parts in fresh.items()}
            extra = {**self._manifest, "iteration": iteration, **({"logs": logs} if logs else {})}
            write_checkpoint(self.checkpoints, step, state, extra)
            self.written = (iteration, step)
            if self.cases is not None and batch is not None:
                self.cases.drop(batch)
            prune(self.checkpoints, self._keep, self.best)
        except BaseException as error:
            self._failure = error

    def _write_rows(self, name: str, rows: Rows, parts: _NewRows) -> dict[str, Any]:
        folder = self.checkpoints / LOG_FOLDER / name
        shards = self._shards.setdefault(name, [])
        for start, stop, columns in parts:
            data = tensor_bytes({column: value.contiguous() for column, value in columns.items()})
            shard = Shard(start=start, stop=stop, size=len(data), sha256=sha256(data))
            with disk_errors(folder):
                for path in (folder.parent, folder):  # not `parents=True`: a deleted run must not be created again
                    path.mkdir(exist_ok=True)
            write_atomic(folder / shard.file, data)
            shards.append(shard)
        if parts:
            sync_folder(folder)
        shards[:] = [shard for shard in shards if shard.stop > rows.first]
        return {"first": rows.first, "stop": rows.stop, "shards": [shard.model_dump() for shard in shards]}


def manifest_entries(run: Run, trainer: str, layout: Layout, deployment: dict[str, Any]) -> dict[str, Any]:
    """Return the entries of a manifest that all checkpoints of a run share.

    Args:
        run: the run.
        trainer: name of the trainer, or of the format of an imported policy.
        layout: layout of observations and actions.
        deployment: description of the environment for deployment (`rlcli.deploy.env_description`).
    """
    return {
        **{key: run.record[key] for key in ("task", "agent", "seed")},
        "trainer": trainer,
        "layout": layout.record(),
        "deployment": deployment,
        "versions": {"rlcli": run.record["rlcli"], **run.record["versions"]},
    }


def write_checkpoint(checkpoints: Path, step: int, state: TrainerState, extra: Mapping[str, Any]) -> Path:
    """Write one checkpoint atomically and return its folder.

    All files are written and synced in a temporary folder, the manifest last. Then the folder is renamed.

    Args:
        checkpoints: the run's folder of checkpoints.
        step: environment steps of the training, which name the folder of the checkpoint.
        state: state of the trainer.
        extra: further entries of `manifest.json`.

    Raises:
        MachineError: if the checkpoint cannot be written; no part of the checkpoint is left.
    """
    target = checkpoints / f"{step:012d}"
    if target.exists():
        return target
    temporary = _temporary_folder(checkpoints)
    files: dict[str, dict[str, Any]] = {}

    def put(name: str, data: bytes) -> None:
        write_synced(temporary / name, data)
        files[name] = {"size": len(data), "sha256": sha256(data)}

    try:
        with disk_errors(target):
            temporary.mkdir()
            put("policy.json", to_json(state.values["policy"]).encode())
            put("state.json", to_json(state.values).encode())
            for part, tensors in state.tensors.items():
                contiguous = {name: value.detach().contiguous() for name, value in tensors.items()}
                put(f"{part}.safetensors", tensor_bytes(contiguous))
            manifest = {"format": FORMAT, "step": step, **extra, "files": files}
            write_synced(temporary / "manifest.json", to_json(manifest).encode())
            sync_folder(temporary)
            require_lock(target)
            os.rename(temporary, target)
            sync_folder(checkpoints)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)  # the temporary folder still exists only after an error
    write_atomic(checkpoints / "latest", target.name + "\n")
    return target


def prune(checkpoints: Path, keep: KeepRule, best: int | None) -> None:
    """Remove the checkpoints that `keep` does not keep, and rows of logs (replay buffers) that only they need.

    A checkpoint that cannot be removed stays complete.

    Args:
        checkpoints: the run's folder of checkpoints.
        keep: rule for the checkpoints to keep.
        best: step of the best checkpoint; None: no evaluation has found one.
    """
    saved = steps(checkpoints)
    if keep.last is None or len(saved) <= keep.last + 1:
        return
    for step in saved[1 : -keep.last]:
        folder = checkpoints / f"{step:012d}"
        with contextlib.suppress(OSError, CheckpointError):  # a checkpoint that cannot be read is kept
            iteration = open_checkpoint(folder).iteration
            if step != best and not (keep.every and iteration % keep.every == 0):
                _remove(folder)
    drop_rows(checkpoints)


def drop_after(checkpoints: Path, step: int) -> list[int]:
    """Remove the checkpoints after the environment step at which training is resumed; return their steps, ascending.

    A checkpoint that cannot be read is renamed to `STEP.unreadable` instead, and rows of logs (replay buffers) that
    no other checkpoint needs are moved into its folder.
    """
    later = [saved for saved in steps(checkpoints) if saved > step]
    removed, aside = [], None
    for saved in reversed(later):
        folder = checkpoints / f"{saved:012d}"
        try:
            open_checkpoint(folder).verify(whole=True)
        except CheckpointError as error:
            aside = _set_aside(folder)
            _log.warning(f"checkpoint {folder} cannot be read and is renamed to {aside.name}: {error.message}")
        else:
            _remove(folder)
            removed.append(saved)
    # also if no checkpoint was removed: a killed run may not have written this file
    write_atomic(checkpoints / "latest", f"{step:012d}\n")
    drop_rows(checkpoints, aside)
    return removed[::-1]


def drop_rows(checkpoints: Path, aside: Path | None = None) -> None:
    """Remove the files with rows of logs (of a replay buffer) that no checkpoint needs, or move them to `aside`.

    If a checkpoint cannot be read, no file is removed.
    """
    files = set((checkpoints / LOG_FOLDER).glob("*/*.safetensors"))
    if not files:
        return
    try:
        for step in steps(checkpoints):
            for name, shards in open_checkpoint(checkpoints / f"{step:012d}").shards().items():
                files -= {checkpoints / LOG_FOLDER / name / shard.file for shard in shards}
    except CheckpointError:
        return  # a damaged checkpoint: which rows it needs is unknown
    for file in files:
        with contextlib.suppress(MachineError), disk_errors(file):
            if aside is None:
                file.unlink(missing_ok=True)
            else:
                target = aside / file.relative_to(checkpoints)
                target.parent.mkdir(parents=True, exist_ok=True)
                file.rename(target)


def remove_temporary_files(checkpoints: Path) -> None:
    """Remove temporary files that killed processes have left in a run; `checkpoints` is the run's checkpoint folder."""
    for leftover in checkpoints.glob(".tmp-*"):
        shutil.rmtree(leftover, ignore_errors=True)
    run = checkpoints.parent
    for folder in (checkpoints, run, run / "tb", run / FOLDER, *(checkpoints / LOG_FOLDER).glob("*")):
        for file in folder.glob(".*.tmp-*"):
            file.unlink(missing_ok=True)


def _remove(folder: Path) -> None:
    """Rename a checkpoint to a temporary folder, then delete that folder."""
    temporary = _temporary_folder(folder.parent)
    try:
        with disk_errors(folder):
            folder.rename(temporary)
    except MachineError:
        return
    shutil.rmtree(temporary, ignore_errors=True)


def _set_aside(folder: Path) -> Path:
    """Rename a damaged checkpoint to `STEP.unreadable`, so that it is not read; return the new folder."""
    target, number = folder.with_name(f"{folder.name}.unreadable"), 1
    while os.path.lexists(target):
        number += 1
        target = folder.with_name(f"{folder.name}.unreadable-{number}")
    with disk_errors(target):
        return folder.rename(target)


def _temporary_folder(parent: Path) -> Path:
    """Return a new name for a temporary folder; `remove_temporary_files` removes it if this process is killed."""
    return parent / f".tmp-{os.getpid()}-{secrets.token_hex(4)}"

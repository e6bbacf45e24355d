"""Create, open, lock and find runs: folders of one training with configuration, run.json, metrics and checkpoints.

The process that writes to a run locks the run. The files of a downloaded run are untrusted and are checked.
"""

import contextlib
import errno
import functools
import logging
import math
import os
import re
import shutil
import stat
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from rlcli.config import strict_yaml
from rlcli.errors import CheckpointError, MachineError, UsageError
from rlcli.runs.atomic_io import disk_errors, require_lock, to_json, write_atomic
from rlcli.runs.run_lock import LOCK, RunLock
from rlcli.runs.safe_io import (
    FileModel,
    PrintableText,
    check_json,
    read_file,
    read_json,
    require_inside,
    require_plain_entries,
)
from rlcli.safe_text import MAX_SEED

_log = logging.getLogger(__name__)
CONFIG = "config.yaml"
RECORD = "run.json"
STUDY = "study.json"
"""File that marks a study: a folder of runs with several seeds, or of the trials of a sweep."""
WAITING = "waiting"
"""State of a run of a study that has not started yet."""
MAX_NAME = 200
"""Largest length of `--name` [characters]; with the time in front it is a folder's name, of at most 255 bytes."""
_TASK = re.compile(r"(?!\.{1,2}$)[^/\\:]{1,255}")
_MAX_FILES = 100_000
_NAME = re.compile(r"[A-Za-z0-9][\w.-]*", re.ASCII)


@dataclass(slots=True)
class Run:
    """Folder of one training."""

    folder: Path
    """The folder; absolute after `lock`, so that writing does not depend on the current folder, which a task may
    change."""
    record: dict[str, Any] = field(default_factory=dict)
    """Content of run.json: task, seed, state, software and hardware, and so on."""
    _lock: RunLock | None = None
    shown: Path = field(init=False)
    """The folder as it was given, for messages."""

    def __post_init__(self) -> None:
        self.shown = self.folder

    @property
    def config(self) -> Path:
        """File of the resolved configuration."""
        return self.folder / CONFIG

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.folder / "checkpoints"

    @property
    def metrics(self) -> Path:
        """File with one JSON line for each iteration."""
        return self.folder / "metrics.jsonl"

    def read_config(self) -> strict_yaml.Document:
        """Read the resolved configuration.

        Raises:
            CheckpointError: if the file is missing, corrupt, or not a regular file.
        """
        text = read_file(
            self.config, strict_yaml.MAX_BYTES, missing=f"{self.folder} has no {CONFIG}; choose another run"
        )
        try:
            return strict_yaml.load(text)
        except strict_yaml.YamlError as error:
            raise CheckpointError(f"{self.config}:{error.line}:{error.column} is corrupt: {error.message}") from None

    def findings(self) -> list[str]:
        """Return the problems that the health checks of the training have found, a sentence for each."""
        return [f"{each['check']}: {each['message']}; try {each['hint']}" for each in self.record.get("health", ())]

    def update(self, **entries: Any) -> None:
        """Change entries of `record`, and write run.json.

        Raises:
            MachineError: if the disk reports an error, or this process has lost the lock of the run.
        """
        self.record.update(entries)
        write_atomic(self.folder / RECORD, to_json(self.record))

    def lock(self) -> None:
        """Lock the run, so that only this process may write to it.

        Raises:
            MachineError: if another process is writing to this run.
        """
        self.folder = self.folder.absolute()
        lock = RunLock(self.folder)
        with disk_errors(self.folder / LOCK):
            lock.acquire()
        self._lock = lock

    def unlock(self) -> None:
        """Release the lock."""
        if self._lock is not None:
            self._lock.release()

    def discard(self) -> None:
        """Delete a run whose training did not start, if this process still holds the lock; then release the lock."""
        with contextlib.suppress(MachineError):
            require_lock(self.folder)
            shutil.rmtree(self.folder, ignore_errors=True)
        self.unlock()


def create_run(runs_dir: Path, task: str, name: str | None, config: str, record: Mapping[str, Any]) -> Run:
    """Create and lock a new run; runs that start in the same second get different folders.

    Args:
        runs_dir: the folder of runs.
        task: name of the task.
        name: part of the name of the run's folder; None: the name is only a time.
        config: the resolved configuration, as YAML.
        record: the first content of run.json.

    Raises:
        UsageError: if the name cannot be part of a folder's name.
        MachineError: if the folder cannot be created or written.
    """
    return initialize_run(new_folder(runs_dir, task, name), config, record)


def new_folder(runs_dir: Path, task: str, name: str | None) -> Path:
    """Create a folder for a run or a study, with the UTC time in its name.

    Raises:
        UsageError: if a name cannot be part of a folder's name.
        MachineError: if the folder cannot be created.
    """
    require_name(name)
    if len(os.fsencode(task)) > 255:
        message = f"the task's name has {len(os.fsencode(task))} bytes, but a folder's name at most 255"
        raise UsageError(message, hint="give the task a shorter name")
    parent = runs_dir / task
    stem = datetime.now(UTC).strftime("%Y-%m-%d_%H-%M-%S") + (f"-{name}" if name else "")
    with disk_errors(parent):
        parent.mkdir(parents=True, exist_ok=True)
        return _create_numbered_folder(parent, stem)


def require_name(name: str | None) -> None:
    """Check that a name can be part of a folder's name.

    Raises:
        UsageError: if the name is not allowed.
    """
    if name is not None and not _NAME.fullmatch(name):
        hint = "begin with a letter or digit; then letters, digits, '.', '-' and '_' are allowed"
        raise UsageError(f"--name '{name}' cannot be part of a folder's name", hint=hint)
    if name is not None and len(name) > MAX_NAME:
        message = f"--name has {len(name)} characters; at most {MAX_NAME} are allowed"
        raise UsageError(message, hint="shorten the name")


def initialize_run(folder: Path, config: str, record: Mapping[str, Any]) -> Run:
    """Write the first files of a new run into its empty folder, and lock it for this process.

    Args:
        folder: the folder.
        config: content of config.yaml, the resolved configuration.
        record: first entries of run.json.

    Raises:
        MachineError: if the folder cannot be written; it is deleted.
    """
    run = Run(folder)
    with disk_errors(folder, remove=True):
        run.lock()
        try:
            run.checkpoints.mkdir()
            write_atomic(run.config, config)
            run.update(
                **{"started": datetime.now(UTC).isoformat(timespec="microseconds"), "state": "running", **record}
            )
        except BaseException:
            run.unlock()
            raise
    return run


def open_run(folder: Path) -> Run:
    """Open an existing run, check run.json, and check that its files are regular files.

    Raises:
        CheckpointError: if the folder is not a valid run.
    """
    record = read_json(folder, RECORD, missing=f"{folder} is not a run, because it has no {RECORD}; check the path")
    require_plain_run(folder)
    for part in (folder / CONFIG, folder / "metrics.jsonl"):
        if part.is_dir():
            raise CheckpointError(f"{part} is a folder, but must be a file; move the folder out of the run's folder")
    check_json(RunRecord, record, folder / RECORD)
    return Run(folder, record)


def require_plain_run(folder: Path) -> None:
    """Check that the folders of a run into which a training writes contain only regular files and folders.

    Raises:
        CheckpointError: for the first entry that is a link, a pipe or a device.
    """
    for inner in ("", "checkpoints", "checkpoints/logs"):
        if (folder / inner).is_dir():
            require_plain_entries(folder / inner)


def run_folders(runs_dir: Path) -> Iterator[Path]:
    """Yield the folders in which runs are expected: RUNS/TASK/RUN and RUNS/TASK/STUDY/RUN, without hidden ones."""
    for task in _subfolders(runs_dir):
        for folder in _subfolders(task):
            if (folder / STUDY).is_file():
                yield from _subfolders(folder)
            else:
                yield folder


def runs_below(folder: Path, depth: int = 3) -> Iterator[Path]:
    """Yield the folders of the runs in a folder of runs, of a task or of a study; search at most `depth` levels."""
    for below in _subfolders(folder):
        if (below / RECORD).is_file():
            yield below
        elif depth > 1:
            yield from runs_below(below, depth - 1)


def _subfolders(folder: Path) -> list[Path]:
    """Return the folders in a folder, without hidden ones and links: a link could lead to all files of the machine."""
    try:
        with os.scandir(folder) as entries:
            found = [entry for entry in entries if not entry.name.startswith(".") and entry.is_dir()]
    except OSError:
        return []
    for entry in found:
        if entry.is_symlink():
            _warn_of_link(entry.path)
    return [Path(entry.path) for entry in found if not entry.is_symlink()]


@functools.cache
def _warn_of_link(path: str) -> None:
    """Log one warning for a link, however often its folder is searched."""
    _log.warning("%s is a link; rlcli does not search it for runs", path)


def require_own(run: Run, *parts: str) -> None:
    """Check that files of a run can be written safely: no link leads out of the run, and none is a pipe or device.

    Args:
        run: the run.
        parts: files and folders in the run; a folder stands for everything in it.

    Raises:
        CheckpointError: for the first path that is a link out of the run, a pipe or a device.
    """
    count = 0
    pending = [run.folder / part for part in parts]
    while pending:
        path = pending.pop()
        count += 1
        try:
            require_inside(run.folder, path)
            mode = path.stat().st_mode
            if stat.S_ISDIR(mode):
                pending += path.iterdir()
            elif not stat.S_ISREG(mode):
                raise OSError(errno.EINVAL, "it is not a regular file")
        except FileNotFoundError:
            continue
        except (OSError, RuntimeError) as error:
            reason = getattr(error, "strerror", None) or error
            message, hint = f"{path} cannot be part of a run: {reason}", "move it out of the run's folder"
            raise CheckpointError(message, hint=hint) from None
        if count > _MAX_FILES:
            message = f"{run.folder} has more than {_MAX_FILES} files"
            raise CheckpointError(message, hint="move files that rlcli did not write to another folder")


def _require_task_name(name: str) -> str:
    if not _TASK.fullmatch(name):
        raise ValueError("the task's name must not have '/', '\\' or ':', because it is part of a path")
    return name


class TaskRecord(FileModel):
    """Entry `task` of run.json or of another untrusted file: the task's name, and where it comes from."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, PrintableText | None] = Field(init=False)

    name: Annotated[PrintableText, AfterValidator(_require_task_name)]
    folder: PrintableText | None = None
    distribution: PrintableText | None = None


class RecordedTask(TaskRecord):
    """Entry `task` of run.json, which must name the source of the task: a folder or an installed distribution."""

    @model_validator(mode="after")
    def _check_origin(self) -> Self:
        if not (self.folder or self.distribution):
            raise ValueError("the origin of the task is missing: 'folder' or 'distribution'; the file is damaged")
        return self


class _Finding(FileModel):
    check: PrintableText
    iteration: Annotated[int, Field(ge=0)]
    message: PrintableText
    hint: PrintableText


def seconds_since(stamp: object) -> float:
    """Return the seconds since an ISO time stamp, negative if the stamp is in the future; infinity if malformed."""
    try:
        return time.time() - datetime.fromisoformat(str(stamp)).timestamp()
    except (ValueError, OverflowError, OSError):
        return math.inf


class RunRecord(FileModel):
    """The entries of run.json that rlcli reads."""

    task: RecordedTask
    seed: Annotated[int, Field(ge=0, le=MAX_SEED)]
    agent: str | None = None
    best: int | None = None
    cpu: dict[str, Any] = Field(default_factory=dict)
    given: dict[str, Any] = Field(default_factory=dict)
    health: Annotated[list[_Finding], Field(max_length=1000)] = Field(default_factory=list)
    init_from: str | None = None
    iteration: int = 0
    loggers: list[str] = Field(default_factory=list)
    resumed: list[Any] = Field(default_factory=list)
    rlcli: str = ""
    sources: dict[str, Any] = Field(default_factory=dict)
    started: str = ""
    state: str = ""
    step: int = 0
    torch: dict[str, Any] = Field(default_factory=dict)
    torch_threads: Annotated[int, Field(ge=1, le=4096)] = 1
    trained_s: float = 0.0
    trackers: dict[str, Any] = Field(default_factory=dict)
    versions: dict[str, Any] = Field(default_factory=dict)
    video_every: Annotated[int, Field(ge=0, lt=2**31)] = 0


def _create_numbered_folder(parent: Path, stem: str) -> Path:
    """Create and return the folder `stem` in `parent`, or `stem-2`, `stem-3`, ... if `stem` exists."""
    for attempt in range(1, 10_000):
        folder = parent / (stem if attempt == 1 else f"{stem}-{attempt}")
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
            return folder
    raise OSError(errno.EEXIST, f"{stem} and {stem}-2 to {stem}-9999 all exist; use another --name", str(parent / stem))

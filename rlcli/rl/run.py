"""Run folders: what was run, with what, and what came of it; and how a command line names one."""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from rlcli.config.settings import setting
from rlcli.errors import CheckpointError, MachineError, UsageError, did_you_mean, listing
from rlcli.rl.files import disk_error, to_json, write_atomic
from rlcli.rl.reading import JSON_LIMIT, parse_json, read_file, refuse_links

CONFIG = "config.yaml"
RECORD = "run.json"
STUDY = "study.json"
"""What a folder holds whose folders are runs of one study: the seeds of a training, or the trials of a sweep."""
WAITING = "waiting"
"""State of a run of a study whose turn has not come."""
LOCK = ".lock"
MAX_SEED = 2**62
_TASK = re.compile(r"(?!\.{1,2}$)[^/\\:]{1,255}")
_MOST = 4 * 1024 * 1024
"""Bytes of a run.json."""
_MANY = 100_000
_MOST_THREADS = 4096
_PEEK_S = 0.3
"""For longer than somebody looks whether a run is locked."""
_NAME = re.compile(r"[A-Za-z0-9][\w.-]*", re.ASCII)


@dataclass(slots=True)
class Run:
    """One training run's folder. `record` is the content of run.json."""

    folder: Path
    record: dict[str, Any] = field(default_factory=dict)
    _lock: FileLock | None = None

    @property
    def config(self) -> Path:
        """The resolved configuration."""
        return self.folder / CONFIG

    @property
    def checkpoints(self) -> Path:
        """The folder of checkpoints."""
        return self.folder / "checkpoints"

    @property
    def metrics(self) -> Path:
        """One JSON line an iteration."""
        return self.folder / "metrics.jsonl"

    def update(self, **entries: Any) -> None:
        """Change entries of run.json."""
        self.record.update(entries)
        write_atomic(self.folder / RECORD, to_json(self.record))

    def lock(self) -> None:
        """Keep a second writer out.

        Raises:
            MachineError: if another process is writing to this run.
        """
        self._lock = FileLock(self.folder / LOCK, timeout=_PEEK_S)
        try:
            self._lock.acquire()
        except Timeout:
            self._lock = None
            raise MachineError(f"{self.folder} is being written to by another process") from None

    def unlock(self) -> None:
        """Let others write again."""
        if self._lock is not None:
            self._lock.release()
            self._lock = None

    def discard(self) -> None:
        """Remove a run that never began."""
        self.unlock()
        shutil.rmtree(self.folder, ignore_errors=True)


def create_run(runs_dir: Path, task: str, name: str | None, config: str, record: Mapping[str, Any]) -> Run:
    """Make a new run folder with its configuration in it; two that start in the same second get two folders.

    Raises:
        UsageError: for a name that cannot be part of a folder's.
        MachineError: if the folder cannot be made or written.
    """
    return begin_run(new_folder(runs_dir, task, name), config, record)


def new_folder(runs_dir: Path, task: str, name: str | None) -> Path:
    """A folder for a run or a study of runs, with the time in its name.

    Raises:
        UsageError: for a name that cannot be part of a folder's.
        MachineError: if the folder cannot be made.
    """
    require_name(name)
    parent = runs_dir / task
    stem = datetime.now(UTC).strftime("%Y-%m-%d_%H-%M-%S") + (f"-{name}" if name else "")
    try:
        parent.mkdir(parents=True, exist_ok=True)
        return _fresh_folder(parent, stem)
    except OSError as error:
        raise disk_error(parent, error) from error


def require_name(name: str | None) -> None:
    """A name can be part of a folder's.

    Raises:
        UsageError: if it cannot.
    """
    if name is not None and not _NAME.fullmatch(name):
        raise UsageError(f"--name '{name}' cannot be part of a folder's name", hint="letters, digits, - and _")


def begin_run(folder: Path, config: str, record: Mapping[str, Any]) -> Run:
    """Write what a run is to do into its empty folder, and lock it.

    Raises:
        MachineError: if it cannot be written; the folder is gone then.
    """
    run = Run(folder)
    try:
        run.checkpoints.mkdir()
        write_atomic(run.config, config)
        run.update(**{"started": datetime.now(UTC).isoformat(timespec="microseconds"), "state": "running", **record})
        run.lock()
    except (OSError, MachineError) as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise disk_error(folder, error) if isinstance(error, OSError) else error from error
    return run


def open_run(folder: Path) -> Run:
    """Open an existing run.

    Raises:
        CheckpointError: if it is not a run.
    """
    file = folder / RECORD
    try:
        require_inside(folder, file)
        record = parse_json(read_file(file, min(JSON_LIMIT, _MOST)), file)
    except (FileNotFoundError, NotADirectoryError):
        raise CheckpointError(f"{folder} is not a run: it has no {RECORD}") from None
    except OSError as error:
        raise CheckpointError(f"{file} cannot be read: {error.strerror or error}") from None
    refuse_links(folder)
    for inner in ("checkpoints", "checkpoints/logs"):
        if (folder / inner).is_dir():
            refuse_links(folder / inner)
    for part in (folder / CONFIG, folder / "metrics.jsonl"):
        if part.exists() and not part.is_file():
            raise CheckpointError(f"{part} is no plain file")  # a pipe would be waited for
    _check(record, file)
    return Run(folder, record)


def is_locked(folder: Path) -> bool:
    """Whether a process is writing to the run: asked of the system, without a trace in the folder."""
    try:
        handle = os.open(folder / LOCK, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
    except OSError:
        return False
    try:
        return stat.S_ISREG(os.fstat(handle).st_mode) and not _shared(handle)
    finally:
        os.close(handle)


def _shared(handle: int) -> bool:
    """Whether a lock file can be locked together with others; the lock is let go with the handle."""
    try:
        import fcntl
    except ImportError:  # Windows
        import msvcrt

        try:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
            msvcrt.locking(handle, msvcrt.LK_UNLCK, 1)  # type: ignore[attr-defined]
        except OSError:
            return False
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True


def require_own(run: Run, *parts: str) -> None:
    """What is about to be written lies in the run: no link leads out of it, no pipe or device stands in a file's place.

    Args:
        run: the run.
        parts: files and folders in it; of a folder all that it holds.

    Raises:
        CheckpointError: naming what does not belong in a run.
    """
    seen = 0
    pending = [run.folder / part for part in parts]
    while pending:
        path = pending.pop()
        seen += 1
        try:
            require_inside(run.folder, path)
            mode = path.stat().st_mode
            if stat.S_ISDIR(mode):
                pending += path.iterdir()
            elif not stat.S_ISREG(mode):
                raise OSError(errno.EINVAL, "it is not a plain file")
            if seen > _MANY:
                raise OSError(errno.EFBIG, f"the run holds more than {_MANY} files")
        except FileNotFoundError:
            continue
        except (OSError, RuntimeError) as error:
            said = getattr(error, "strerror", None) or error
            raise CheckpointError(f"{path} cannot be written to: {said}", hint="it was not made by rlcli") from None


def find_run(reference: str, runs_dir: Path, task: str | None = None) -> tuple[Run, str]:
    """A run by its folder, its name, or `latest`; and why it was chosen.

    Raises:
        CheckpointError: if there is none.
        UsageError: if it is a run of another task than the one given.
    """
    run, why = _find_run(reference, runs_dir, task)
    if task is not None and run.record["task"]["name"] != task:
        raise UsageError(f"{run.folder} is a run of {run.record['task']['name']}, not of {task}", hint="leave out TASK")
    return run, why


def list_runs(runs_dir: Path, task: str | None) -> list[Run]:
    """Runs under a folder, oldest first; what is not a run is passed over."""
    runs = []
    for file in (*runs_dir.glob(f"*/*/{RECORD}"), *runs_dir.glob(f"*/*/*/{RECORD}")):
        if not _stands_right(file, runs_dir):
            continue
        try:
            run = open_run(file.parent)
        except CheckpointError:
            continue
        if task is None or run.record["task"].get("name") == task:
            runs.append(run)
    return sorted(runs, key=lambda run: (str(run.record.get("started", "")), run.folder.name))


def _stands_right(file: Path, runs_dir: Path) -> bool:
    """Whether a run lies in a task's folder, or in a study that does."""
    deep = len(file.relative_to(runs_dir).parts) == 4
    return not deep or (file.parent.parent / STUDY).is_file()


def find_checkpoint(
    reference: str,
    runs_dir: Path,
    task: str | None = None,
    *,
    whole: bool = False,
    tell: Callable[[str], None] = lambda _: None,
) -> tuple[Run, Path, str]:
    """A checkpoint by `RUN`, `RUN@best`, `RUN@step:N`, `latest` or its folder; and why it was chosen.

    Of a run that is named without a checkpoint it is the newest good one.

    Args:
        reference: what was named.
        runs_dir: the folder of runs.
        task: of which it must be.
        whole: good is what can be resumed, not only what can be played.
        tell: hears of checkpoints that were passed over, and why.

    Raises:
        CheckpointError: if there is none.
    """
    from rlcli.rl.checkpoint import steps

    folder = Path(reference)
    if os.path.isfile(folder / "manifest.json"):  # of a name too long for the system: no
        return open_run(folder.resolve().parent.parent), folder, "as named"
    name, _, which = (reference, "", "") if os.path.exists(folder) else reference.partition("@")
    run, why = find_run(name, runs_dir, task)
    have = steps(run.checkpoints)
    if not have:
        raise CheckpointError(f"{run.folder} has no complete checkpoint")
    if not which:
        return run, *_newest_good(run, have, why, whole, tell)
    if which == "best":
        best = run.record.get("best")
        if best not in have:
            raise CheckpointError(
                f"{run.folder} has no best checkpoint: it was not evaluated",
                hint="leave out @best for the newest",
            )
        return run, run.checkpoints / f"{best:012d}", "its best evaluation"
    kind, _, number = which.partition(":")
    if kind == "step" and re.fullmatch("[0-9]{1,30}", number):
        if int(number) not in have:
            raise CheckpointError(
                f"{run.folder} has no checkpoint at step {number}", hint=f"steps: {listing(map(str, have))}"
            )
        return run, run.checkpoints / f"{int(number):012d}", "as named"
    raise CheckpointError(
        f"'{reference}' does not name a checkpoint",
        hint="RUN, RUN@best, RUN@step:N, a checkpoint folder, or latest",
    )


def require_inside(folder: Path, file: Path) -> None:
    """A file of a folder lies in it, links followed.

    Raises:
        OSError: if a link leads elsewhere.
    """
    real = Path(os.path.realpath(file))  # where resolve() would raise something else for a link to itself
    if not real.is_relative_to(os.path.realpath(folder)):
        raise OSError(errno.ELOOP, "it is a link that leads elsewhere", str(file))


def _newest_good(run: Run, have: list[int], why: str, whole: bool, tell: Callable[[str], None]) -> tuple[Path, str]:
    """The newest checkpoint that is in order; each that is passed over is told of."""
    from rlcli.rl.checkpoint import open_checkpoint

    for passed, step in enumerate(reversed(have)):
        folder = run.checkpoints / f"{step:012d}"
        try:
            open_checkpoint(folder).verify(whole=whole)
        except CheckpointError as error:
            if passed == len(have) - 1:
                raise
            tell(f"checkpoint {folder.name} is passed over: {error.message}")
            continue
        return folder, f"{why}, its newest {'good ' if passed else ''}checkpoint"
    raise AssertionError("a run without checkpoints is refused before")


def default_runs_dir() -> Path:
    """RLCLI_RUNS_DIR, or what the user's settings say, or `runs` in the current folder."""
    return Path(os.environ.get("RLCLI_RUNS_DIR") or Path(setting("runs_dir") or "runs").expanduser())


_TYPES: dict[str, tuple[type, ...]] = {
    "agent": (str, type(None)),
    "best": (int, type(None)),
    "init_from": (str, type(None)),
    "iteration": (int,),
    "loggers": (list,),
    "resumed": (list,),
    "rlcli": (str,),
    "started": (str,),
    "state": (str,),
    "step": (int,),
    "torch_threads": (int,),
    "trained_s": (float, int),
    "trackers": (dict,),
    "versions": (dict,),
    "video_every": (int,),
}


def _check(record: Any, file: Path) -> None:
    """The entries of run.json that are read again are what they should be."""
    task = check_task(record.get("task") if isinstance(record, dict) else None, file)
    if not (task.get("folder") or task.get("distribution")) or type(record.get("seed")) is not int:
        raise CheckpointError(f"{file} is corrupt: it does not say where the task is from, or has no seed")
    if not 0 <= record["seed"] <= MAX_SEED:
        raise CheckpointError(f"{file} is corrupt: its seed is out of range")
    for key, types in _TYPES.items():
        if key in record and type(record[key]) not in types:
            raise CheckpointError(f"{file} is corrupt: its {key} is a {type(record[key]).__name__}")
    if not all(isinstance(name, str) for name in record.get("loggers", [])):
        raise CheckpointError(f"{file} is corrupt: its loggers are malformed")
    if not 0 < record.get("torch_threads", 1) <= _MOST_THREADS:
        raise CheckpointError(f"{file} is corrupt: its torch_threads is out of range")
    if not 0 <= record.get("video_every", 0) < 2**31:
        raise CheckpointError(f"{file} is corrupt: its video_every is out of range")


def check_task(task: Any, file: Path) -> dict[str, Any]:
    """What a stranger's file says of a task: it names one, and all that it says are words.

    Raises:
        CheckpointError: if that is not so.
    """
    if not isinstance(task, dict) or not isinstance(task.get("name"), str):
        raise CheckpointError(f"{file} is corrupt: it does not name a task")
    wrong = [key for key, value in task.items() if value is not None and not isinstance(value, str)]
    wrong += [key for key, value in task.items() if isinstance(value, str) and not _is_word(value)]
    if wrong or not _TASK.fullmatch(task["name"]):
        raise CheckpointError(f"{file} is corrupt: its task's {(wrong or ['name'])[0]} is malformed")
    return task


def _is_word(text: str) -> bool:
    """Whether text can be a name or a path."""
    return len(text) <= 4096 and text.isprintable()


def _find_run(reference: str, runs_dir: Path, task: str | None) -> tuple[Run, str]:
    if reference == "latest":
        runs = list_runs(runs_dir, task)
        if not runs:
            of = f" of {task}" if task else ""
            raise CheckpointError(f"there is no run{of} in {runs_dir}", hint=f"rlcli train {task or 'TASK'} makes one")
        return runs[-1], f"newest run of {task}" if task else f"newest run in {runs_dir}"
    for candidate in (
        Path(reference),
        runs_dir / reference,
        *([runs_dir / task / reference] if task else []),
    ):
        if os.path.isfile(candidate / RECORD):
            return open_run(candidate), "as named"
        if os.path.isfile(candidate / STUDY):
            inside = sorted(file.parent.name for file in candidate.glob(f"*/{RECORD}"))
            raise CheckpointError(
                f"{candidate} is a study of several runs",
                hint=f"name one: {listing(str(candidate / n) for n in inside)}",
            )
    matches = [run for run in list_runs(runs_dir, None) if run.folder.name == reference]
    if len(matches) == 1:
        return matches[0], "as named"
    names = [run.folder.name for run in list_runs(runs_dir, None)]
    near = did_you_mean(reference, names)
    raise CheckpointError(f"no run '{reference}'", hint=near or f"runs in {runs_dir}: {listing(names[-5:])}")


def _fresh_folder(parent: Path, stem: str) -> Path:
    for attempt in range(1, 10_000):
        folder = parent / (stem if attempt == 1 else f"{stem}-{attempt}")
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise OSError(17, "too many runs of this name", str(parent / stem))

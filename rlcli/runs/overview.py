"""Summarise the runs in a folder, with state, progress and scores, for `rlcli runs`.

The summaries are read from the ends of the runs' files, which may be untrusted, so that thousands of runs take little
time.
"""

import contextlib
import math
import os
import stat
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rlcli.errors import CheckpointError
from rlcli.runs.metric_rows import parse_row
from rlcli.runs.run import CONFIG, RECORD, WAITING, Run, open_run, run_folders, seconds_since
from rlcli.runs.run_lock import is_locked
from rlcli.runs.safe_io import read_tail

ENDED = {"finished", "stopped", "diverged", "failed"}
"""Recorded states of runs that have ended. A run whose state is `running` and that is not locked was interrupted."""
_TAIL_BYTES = 32 * 1024
_MAX_ROWS = 20
"""Number of newest rows of metrics, or of evaluations, that are read."""
_MAX_ROW_BYTES = 1024**2
_MAX_SEARCH_BYTES = 64 * 1024**2
"""Number of bytes at the end of `metrics.jsonl` that are searched for the row of one step."""
_MAX_FILES = 20_000
_STARTING_S = 5.0
"""Age up to which a folder without run.json may belong to a run that is being created [s].

A folder whose time stamp is further in the future than this was dated by the clock of another machine.
"""


@dataclass(slots=True)
class Overview:
    """Summary of one run, or of a folder that should be a run but cannot be read."""

    folder: Path
    task: str
    state: str
    """running, waiting, finished, stopped, interrupted, diverged, failed, or broken."""
    reason: str | None = None
    """Why the run failed, diverged, was interrupted or is broken, if known."""
    resumable: bool = False
    iteration: int | None = None
    iterations: int | None = None
    """Number of iterations of the whole training."""
    step: int | None = None
    last: dict[str, float] = field(default_factory=dict)
    """Values `return` and `success` of the newest iteration that has them; empty before the first episode has ended."""
    best: dict[str, float] = field(default_factory=dict)
    """Values `step`, `return` and `success` of the best evaluation during training; empty without evaluations."""
    evaluation: dict[str, Any] = field(default_factory=dict)
    """Values `step`, `episodes`, `return` and `success` of the newest checkpoint that `rlcli eval` has evaluated."""
    started: str | None = None
    age_s: float | None = None
    """Time since the start [s]."""
    duration_s: float | None = None
    """Training time, summed over all resumptions [s]."""
    size_bytes: int = 0
    agent: str | None = None
    seed: int | None = None
    tags: dict[str, Any] = field(default_factory=dict)
    """Further settings: device, processes, source of the initial weights, loggers, videos."""

    def document(self) -> dict[str, Any]:
        """Return the summary as plain JSON."""
        values = asdict(self)
        return {"run": str(values.pop("folder")), **values}


def overviews(runs_dir: Path) -> list[Overview]:
    """Return the summaries of all runs in the folder of runs, the newest first; runs without a start time are last."""
    found = [overview(folder) for folder in run_folders(runs_dir)]
    return sorted(found, key=lambda run: (run.started or "", run.folder.name), reverse=True)


def overview(folder: Path) -> Overview:
    """Return the summary of a run's folder; if the run cannot be read, its state is `broken`, its reason the error."""
    try:
        run = open_run(folder)
    except (CheckpointError, OSError) as error:
        if _is_new(folder):
            return Overview(folder, folder.parent.name, "running", "the run is being created", age_s=0.0)
        message = getattr(error, "message", None) or getattr(error, "strerror", None) or str(error)
        return Overview(folder, folder.parent.name, "broken", message, size_bytes=_size(folder))
    return overview_of(run)


def overview_of(run: Run) -> Overview:
    """Return the summary of an opened run."""
    record = run.record
    state, reason = state_of(run)
    overview = Overview(
        run.folder,
        record["task"]["name"],
        state,
        reason,
        resumable=state != "running" and _resumable(run),
        iterations=as_count(record.get("iterations")),
        started=record.get("started"),
        size_bytes=_size(run.folder),
        agent=record.get("agent"),
        seed=record["seed"],
        tags=_tags(record),
    )
    newest: dict[str, Any] = {}
    for row in _rows_backwards(run):
        newest = newest or row
        overview.last = _score(row, "Train/")
        if overview.last:  # in some iterations no episode ends
            break
    overview.iteration = as_count(newest.get("iteration", record.get("iteration"))) or 0
    overview.step = as_count(newest.get("step", record.get("step"))) or 0
    if state == "finished" and overview.iterations is None:
        overview.iterations = overview.iteration
    best = record.get("best")
    if best is not None:
        overview.best = {"step": best, **_score(_row_at(run, best), "Eval/")}
    overview.evaluation = _evaluation(run)
    overview.age_s, overview.duration_s = times(run)
    if not (run.folder / CONFIG).is_file():
        overview.state, overview.reason, overview.resumable = "broken", f"the run has no {CONFIG}", False
    return overview


def state_of(run: Run) -> tuple[str, str | None]:
    """Return the state of a run (see `Overview.state`), and why it failed, diverged, was interrupted or is broken.

    The reason is None for other states, or if it is not known.
    """
    recorded = run.record.get("state", "")
    if is_locked(run.folder):
        return "running", None
    if recorded == "running":  # the run may have ended after its record was read and before its lock is tested
        with contextlib.suppress(CheckpointError, OSError):
            run.record = open_run(run.folder).record
        recorded = run.record.get("state", "")
    why = run.record.get("reason")
    reason = why if isinstance(why, str) and recorded in ("diverged", "failed") else None
    if recorded in ENDED or recorded == WAITING:
        return recorded, reason
    if recorded == "running":
        return "interrupted", "the process of the run was killed, or the machine stopped"
    return "broken", f"{RECORD} has the unknown state '{recorded[:40]}'"


def newest_rows(run: Run) -> list[dict[str, Any]]:
    """Return the last rows (at most 20) of a run's `metrics.jsonl`, the oldest first; a row has numbers by metric."""
    return [*_rows_backwards(run)][::-1]


def _rows_backwards(run: Run) -> Iterator[dict[str, Any]]:
    """Yield at most 20 of the last rows of a run's `metrics.jsonl`, the newest first; corrupt lines are skipped."""
    for size in (_TAIL_BYTES, 2 * _MAX_ROW_BYTES):
        data, whole = _tail(run, size)
        lines = data.split(b"\n")[0 if whole else 1 : -1]  # the text after the last newline is still being written
        if lines:
            break
    yield from (row for line in lines[: -_MAX_ROWS - 1 : -1] if (row := _row(line)) is not None)


def _tail(run: Run, limit: int) -> tuple[bytes, bool]:
    """Return the last `limit` bytes of `metrics.jsonl`, and whether they are the whole file.

    If the file cannot be read, it counts as empty.
    """
    try:
        return read_tail(run.metrics, limit)
    except (OSError, CheckpointError):
        return b"", True


def _is_new(folder: Path) -> bool:
    """Return whether a folder may belong to a run that is being created: run.json is written last."""
    try:
        young = abs(time.time() - folder.stat().st_mtime) < _STARTING_S
        return young and not {RECORD, "metrics.jsonl"} & set(os.listdir(folder))
    except OSError:
        return False


def _row(line: bytes) -> dict[str, Any] | None:
    row = parse_row(line)
    if row is None or any(as_count(row[key]) is None for key in ("iteration", "step")):
        return None
    return row


def _row_at(run: Run, step: int) -> dict[str, Any]:
    """Return the row of metrics at an environment step, metric -> number; an empty dict if there is none."""
    data, _ = _tail(run, _MAX_SEARCH_BYTES)
    at = data.find(f'"step": {step},'.encode())
    line = b"" if at < 0 else data[data.rfind(b"\n", 0, at) + 1 : data.find(b"\n", at)]
    return _row(line) or {}


def _score(row: Mapping[str, Any], prefix: str) -> dict[str, float]:
    metrics = {"return": f"{prefix}mean_reward", "success": f"{prefix}success_rate"}
    return {key: float(row[metric]) for key, metric in metrics.items() if metric in row}


def _evaluation(run: Run) -> dict[str, Any]:
    try:
        names = sorted(name for name in os.listdir(run.folder / "evaluations") if name.endswith(".json"))
    except OSError:
        return {}
    # imported here, because the import takes longer than the rest of this module
    from rlcli.runs.eval_store import read_evaluation

    for name in names[: -_MAX_ROWS - 1 : -1]:
        try:
            found = read_evaluation(run, name.removesuffix(".json"))
        except CheckpointError:
            continue
        if found is not None:
            score = {"step": int(name.removesuffix(".json")), "episodes": found["episodes"]}
            score["return"] = found["return"]["mean"]
            return score | ({"success": found["success"]["rate"]} if "success" in found else {})
    return {}


def as_count(value: object) -> int | None:
    """Return a value of untrusted JSON if it is a valid number of steps or iterations (integer, 0 to 2**63 - 1).

    Return None for any other value.
    """
    return value if type(value) is int and 0 <= value < 2**63 else None


def times(run: Run) -> tuple[float | None, float | None]:
    """Return the time since the start of a run [s], and the training time over all resumptions [s].

    A time is None if the time stamps in the run cannot be right, for example because a clock was changed.
    """
    started = seconds_since(run.record.get("started"))
    age = max(0.0, started) if -_STARTING_S < started < math.inf else None
    before, since = run.record.get("trained_s"), run.record.get("since")
    trained = max(0.0, float(before)) if type(before) is float and math.isfinite(before) else 0.0
    if run.record.get("state") in ENDED and before is not None:
        return age, trained
    try:
        written = run.metrics.stat().st_mtime
    except OSError:
        return age, trained
    now = written - time.time() + (seconds_since(since) if isinstance(since, str) else started)
    return age, trained + max(0.0, now) if now < math.inf else None


def _resumable(run: Run) -> bool:
    """Return whether a run has a checkpoint to resume from, or was stopped before its first checkpoint."""
    try:
        names = os.listdir(run.checkpoints)
    except OSError:
        return False
    has_checkpoint = any(name.isdigit() and os.path.isfile(run.checkpoints / name / "manifest.json") for name in names)
    return has_checkpoint or "step" not in run.record


def _tags(record: Mapping[str, Any]) -> dict[str, Any]:
    tags = {name: record.get(name) for name in ("device", "processes", "init_from", "loggers", "video_every")}
    return {name: value for name, value in tags.items() if value and isinstance(value, str | int | list)}


def _size(folder: Path) -> int:
    """Return the total size of the files in a folder [bytes]; links are not followed."""
    total = visited = 0
    for parent, folders, files in os.walk(folder):
        for name in files:
            with contextlib.suppress(OSError):
                status = os.lstat(os.path.join(parent, name))
                total += status.st_size if stat.S_ISREG(status.st_mode) else 0
        visited += len(folders) + len(files)
        if visited >= _MAX_FILES:
            break
    return total

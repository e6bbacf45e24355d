"""Loggers, which write the metrics of each iteration of a training to files.

`metrics.jsonl` is always written, TensorBoard files if TensorBoard is installed. Experiment trackers, which the user
must name, are in `rlcli.training.trackers`.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import math
import os
import platform
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.errors import DependencyError, pip_install, require_known
from rlcli.registry import load_object
from rlcli.runs.atomic_io import disk_errors, write_atomic
from rlcli.runs.metric_rows import read_rows
from rlcli.runs.run import Run

if TYPE_CHECKING:
    from rlcli.training.trackers import Logger


@dataclass(frozen=True, slots=True)
class LoggerKind:
    """Entry of `LOGGERS`: the class of a logger, and the module that it needs."""

    needs: str
    """Module that must be installed; the extra of rlcli that installs it has the logger's name."""
    factory: str
    """`module:name` of the class."""
    title: str
    """Name of the logger in messages."""


LOGGERS = {
    "tensorboard": LoggerKind("tensorboard", "rlcli.training.loggers:TensorBoard", "TensorBoard"),
    "wandb": LoggerKind("wandb", "rlcli.training.trackers:Wandb", "Weights & Biases"),
    "mlflow": LoggerKind("mlflow", "rlcli.training.trackers:MLflow", "MLflow"),
    "trackio": LoggerKind("trackio", "rlcli.training.trackers:Trackio", "trackio"),
}
"""Name for `--logger` -> logger; `none` means no logger."""


class JsonLines:
    """Logger that writes one JSON object per iteration into `metrics.jsonl`, and flushes the file at once.

    Args:
        file: the file.
        resume_after: iteration at which the run is resumed, after which rows are removed; None: a new run.
    """

    def __init__(self, file: Path, *, resume_after: int | None = None) -> None:
        self._path = file
        with disk_errors(file):
            rows = [] if resume_after is None else [*read_rows(file)]
            self.found = (rows[-1]["iteration"], rows[-1]["step"]) if rows else (0, 0)
            """Iteration and environment steps of the last row that a resumed run found; (0, 0) without a row."""
            if resume_after is not None and file.exists():
                kept = [json.dumps(row) + "\n" for row in rows if row["iteration"] <= resume_after]
                write_atomic(file, "".join(kept))
            self._file = file.open("a", encoding="utf-8", buffering=1)

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Append one line with the metrics of an iteration; infinite and NaN values are left out."""
        with disk_errors(self._path):
            finite = {name: value for name, value in metrics.items() if math.isfinite(value)}
            self._file.write(json.dumps({"iteration": iteration, "step": step, **finite}) + "\n")

    def close(self, state: str = "finished") -> None:
        """Close the file."""
        self._file.close()


class TensorBoard:
    """Logger that writes TensorBoard event files.

    Args:
        folder: folder of the files.
        resume_after_step: environment steps at which the run is resumed, after which events are removed; None: a new
            run.
    """

    def __init__(self, folder: Path, *, resume_after_step: int | None = None) -> None:
        from tensorboard.compat.proto.event_pb2 import Event
        from tensorboard.summary.writer.record_writer import RecordWriter

        name = f"events.out.tfevents.{time.time():.6f}.{platform.node()}.{os.getpid()}"
        with disk_errors(folder):
            folder.mkdir(exist_ok=True)
            if resume_after_step is not None:
                for file in sorted(folder.glob("events.out.tfevents.*")):
                    _remove_events_after(file, resume_after_step)
            self._file = (folder / name).open("wb")
            # SummaryWriter is not used, because its thread prints a traceback when the disk is full
            self._event, self._writer = Event, RecordWriter(self._file)
            self._add(file_version="brain.Event:2")

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Add the metrics of an iteration as scalars at the environment step."""
        values = [{"tag": name, "simple_value": value} for name, value in metrics.items()]
        self._add(step=step, summary={"value": values})

    def close(self, state: str = "finished") -> None:
        """Close the file."""
        self._file.close()

    def _add(self, **entries: Any) -> None:
        try:
            self._writer.write(self._event(wall_time=time.time(), **entries).SerializeToString())
            self._file.flush()
        except OSError:
            with contextlib.suppress(OSError):
                self._file.close()  # the training goes on without a logger that has failed
            raise


def check_loggers(names: Sequence[str] | None) -> list[str]:
    """Return the names of the loggers to use, after a check that they are installed.

    Args:
        names: values of `--logger`, of which `none` means no logger; None or empty: TensorBoard if it is installed.

    Raises:
        UsageError: if a name is not a logger.
        DependencyError: if a logger is not installed.
    """
    if not names:
        return ["tensorboard"] if _installed("tensorboard") else []
    wanted = [name for name in dict.fromkeys(names) if name != "none"]
    for name in wanted:
        require_known(name, [*LOGGERS, "none"], "logger", "loggers")
        if not _installed(name):
            raise DependencyError(f"{LOGGERS[name].title} is not installed", hint=pip_install(f"rlcli[{name}]"))
    return wanted


def open_loggers(
    run: Run, names: Sequence[str], *, resume: tuple[int, int] | None, config: Mapping[str, Any]
) -> list[Logger]:
    """Open the loggers of a run.

    Args:
        run: the run.
        names: names of the loggers besides `metrics.jsonl`.
        resume: iteration and environment steps at which the run is resumed; None: the run is new.
        config: the resolved configuration, which trackers store.

    Raises:
        MachineError: if a logger cannot be opened.
    """
    # imported here, because the import is slow and `check_loggers` does not need it
    from rlcli.training.trackers import FailSafeLogger, open_tracker

    iteration, step = resume if resume is not None else (None, None)
    lines = JsonLines(run.metrics, resume_after=iteration)
    reached = None if resume is None else max(resume, lines.found)
    loggers: list[Logger] = [lines]
    try:
        for name in names:
            make = load_object(LOGGERS[name].factory)
            if name == "tensorboard":
                board = make(run.folder / "tb", resume_after_step=step)
                loggers.append(FailSafeLogger(name, board, 0))
            else:
                loggers.append(open_tracker(name, make, run, config, reached))
    except BaseException:
        for logger in loggers:
            logger.close("failed")
        raise
    return loggers


def _installed(name: str) -> bool:
    return importlib.util.find_spec(LOGGERS[name].needs) is not None


def _remove_events_after(file: Path, step: int) -> None:
    """Remove from a TensorBoard event file the events after a step, and an incomplete last event."""
    from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.summary.writer.record_writer import RecordWriter

    kept = io.BytesIO()
    writer = RecordWriter(kept)
    for data in RawEventFileLoader(str(file)).Load():
        if Event.FromString(data).step <= step:
            writer.write(data)
    write_atomic(file, kept.getvalue())

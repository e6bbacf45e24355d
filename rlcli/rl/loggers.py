"""Where metrics go: always `metrics.jsonl`, and TensorBoard where it is installed."""

from __future__ import annotations

import importlib.util
import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from rlcli.errors import DependencyError, MachineError, UsageError, did_you_mean
from rlcli.rl.files import disk_error, write_atomic
from rlcli.rl.run import Run

LOGGERS = ("tensorboard", "none")
_LONGEST_LINE = 1024**2
"""Bytes of an iteration's metrics."""


class Logger(Protocol):
    """Takes the metrics of every iteration."""

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Record one iteration."""
        ...

    def close(self) -> None:
        """Flush and let go."""
        ...


class JsonLines:
    """`metrics.jsonl`: one object an iteration, on the disk as soon as the iteration is over."""

    def __init__(self, file: Path, *, resume_after: int | None = None) -> None:
        self._path = file
        if resume_after is not None:
            _cut(file, resume_after)
        try:
            self._file = file.open("a", encoding="utf-8", buffering=1)
        except OSError as error:
            raise disk_error(file, error) from error

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Append one line."""
        try:
            finite = {name: value for name, value in metrics.items() if math.isfinite(value)}
            self._file.write(json.dumps({"iteration": iteration, "step": step, **finite}) + "\n")
        except OSError as error:
            raise disk_error(self._path, error) from error

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class TensorBoard:
    """Event files in `tb/`."""

    def __init__(self, folder: Path, *, resume_after_step: int | None = None) -> None:
        from torch.utils.tensorboard import SummaryWriter

        try:
            if resume_after_step is not None:
                for file in sorted(folder.glob("events.out.tfevents.*")):
                    _cut_events(file, resume_after_step)
            self._writer: Any = SummaryWriter(str(folder))
        except OSError as error:
            raise disk_error(folder, error) from error

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Add scalars at the environment step."""
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Flush and close."""
        self._writer.close()


def check_loggers(names: Sequence[str] | None) -> list[str]:
    """The loggers to use; by default TensorBoard where it is installed.

    Raises:
        UsageError: for a name that is no logger.
        DependencyError: for one that is not installed.
    """
    installed = importlib.util.find_spec("tensorboard") is not None
    if not names:
        return ["tensorboard"] if installed else []
    for name in names:
        if name not in LOGGERS:
            raise UsageError(
                f"no logger '{name}'", hint=did_you_mean(name, LOGGERS) or f"loggers: {', '.join(LOGGERS)}"
            )
    if "tensorboard" in names and not installed:
        raise DependencyError("TensorBoard is not installed", hint='pip install "rlcli[tensorboard]"')
    return [name for name in names if name != "none"]


def open_loggers(run: Run, names: Sequence[str], *, resume: tuple[int, int] | None = None) -> list[Logger]:
    """The loggers of a run; `resume` is the (iteration, step) it goes on after."""
    iteration, step = resume if resume is not None else (None, None)
    loggers: list[Logger] = [JsonLines(run.metrics, resume_after=iteration)]
    if "tensorboard" in names:
        loggers.append(TensorBoard(run.folder / "tb", resume_after_step=step))
    return loggers


def read_metrics(file: Path) -> list[dict[str, Any]]:
    """The lines of a metrics file, up to the first that is none: a last one is cut short by a kill."""
    rows = []
    with file.open("rb") as lines:
        for line in iter(lambda: lines.readline(_LONGEST_LINE), b""):
            try:
                row = json.loads(line)
            except (ValueError, RecursionError):
                break
            if not isinstance(row, dict) or not all(type(row.get(key)) is int for key in ("iteration", "step")):
                break
            rows.append(row)
    return rows


def _cut(file: Path, iteration: int) -> None:
    """Drop what a killed run wrote after the checkpoint it is resumed from."""
    if not file.exists():
        return
    try:
        rows = [row for row in read_metrics(file) if row["iteration"] <= iteration]
        write_atomic(file, "".join(json.dumps(row) + "\n" for row in rows))
    except (OSError, MachineError) as error:
        raise disk_error(file, error) if isinstance(error, OSError) else error from error


def _cut_events(file: Path, step: int) -> None:
    """The same of an event file, whose last event may be half written."""
    from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.summary.writer.record_writer import RecordWriter

    kept = io.BytesIO()
    writer = RecordWriter(kept)
    for data in RawEventFileLoader(str(file)).Load():
        if Event.FromString(data).step <= step:
            writer.write(data)
    write_atomic(file, kept.getvalue())

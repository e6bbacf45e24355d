"""Where metrics go: always `metrics.jsonl`, TensorBoard where it is installed, and the trackers that are asked for."""

from __future__ import annotations

import importlib.util
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from rlcli.errors import DependencyError, MachineError, UsageError, did_you_mean
from rlcli.registry import load_object
from rlcli.rl.files import disk_error, write_atomic
from rlcli.rl.run import Run


@dataclass(frozen=True, slots=True)
class Kind:
    """A logger that can be asked for."""

    needs: str
    """The module that must be installed; its extra has the logger's name."""
    opens: str
    """`module:name` of what opens it."""
    title: str


LOGGERS = {
    "tensorboard": Kind("tensorboard", "rlcli.rl.loggers:TensorBoard", "TensorBoard"),
    "wandb": Kind("wandb", "rlcli.rl.trackers:Wandb", "Weights & Biases"),
    "mlflow": Kind("mlflow", "rlcli.rl.trackers:MLflow", "MLflow"),
    "trackio": Kind("trackio", "rlcli.rl.trackers:Trackio", "trackio"),
}
"""By the name that `--logger` takes; `none` is for none of them."""
_LONGEST_LINE = 1024**2
"""Bytes of an iteration's metrics."""


class Logger(Protocol):
    """Takes the metrics of every iteration."""

    def write(self, iteration: int, step: int, metrics: dict[str, float]) -> None:
        """Record one iteration."""
        ...

    def close(self, state: str = "finished") -> None:
        """Flush and let go of a run that is finished, stopped, diverged or failed."""
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

    def close(self, state: str = "finished") -> None:
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

    def close(self, state: str = "finished") -> None:
        """Flush and close."""
        self._writer.close()


def check_loggers(names: Sequence[str] | None) -> list[str]:
    """The loggers to use; by default TensorBoard where it is installed.

    Raises:
        UsageError: for a name that is no logger.
        DependencyError: for one that is not installed.
    """
    if not names:
        return ["tensorboard"] if _installed("tensorboard") else []
    known = [*LOGGERS, "none"]
    wanted = [name for name in dict.fromkeys(names) if name != "none"]
    for name in wanted:
        if name not in LOGGERS:
            raise UsageError(f"no logger '{name}'", hint=did_you_mean(name, known) or f"loggers: {', '.join(known)}")
    for name in wanted:
        if not _installed(name):
            raise DependencyError(f"{LOGGERS[name].title} is not installed", hint=f'pip install "rlcli[{name}]"')
    return wanted


def open_loggers(
    run: Run,
    names: Sequence[str],
    *,
    resume: tuple[int, int] | None = None,
    config: Mapping[str, Any] | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> list[Logger]:
    """The loggers of a run.

    Args:
        run: whose metrics.
        names: those besides `metrics.jsonl`.
        resume: the (iteration, step) it goes on after.
        config: its resolved configuration, for those that keep it.
        tell: hears what the user should know, a logger that fails among it.

    Raises:
        MachineError: if one cannot be opened.
    """
    from rlcli.rl.trackers import Guarded, open_tracker  # heavy, and names are checked before

    iteration, step = resume if resume is not None else (None, None)
    reached = None if resume is None else max(resume, _end(run.metrics))
    loggers: list[Logger] = [JsonLines(run.metrics, resume_after=iteration)]
    try:
        for name in names:
            make = load_object(LOGGERS[name].opens)
            if name == "tensorboard":
                board = make(run.folder / "tb", resume_after_step=step)
                loggers.append(Guarded(name, board, 0, tell))
            else:
                loggers.append(open_tracker(name, make, run, config or {}, reached, tell))
    except BaseException:
        for logger in loggers:
            logger.close("failed")
        raise
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


def _installed(name: str) -> bool:
    return importlib.util.find_spec(LOGGERS[name].needs) is not None


def _end(file: Path) -> tuple[int, int]:
    """How far the iterations of a file go."""
    try:
        last = read_metrics(file)[-1]
    except (OSError, IndexError):
        return 0, 0
    return last["iteration"], last["step"]


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

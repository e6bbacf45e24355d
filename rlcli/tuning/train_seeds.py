"""Train one configuration with several seeds (a study), for `rlcli train --seeds`.

At the end, learning curves that are aggregated over the seeds are written.
"""

import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from rlcli.config.dump import to_data, to_yaml
from rlcli.config.load import Resolved
from rlcli.errors import CheckpointError, DependencyError
from rlcli.reporting.curve_panels import choose
from rlcli.reporting.curves import AXES, Curve, Line, gather
from rlcli.reporting.matplotlib_plots import check_drawing, picture
from rlcli.runs.atomic_io import write_atomic
from rlcli.runs.overview import overview
from rlcli.runs.run import open_run
from rlcli.runs.study import create_study, read_study, runs_of
from rlcli.training.signals import StopRequest
from rlcli.training.start_run import TrainingRequest, run_record
from rlcli.training.train_commands import train_all

_log = logging.getLogger(__name__)

CURVES = "curves.csv"
PICTURE = "curves.svg"
METRICS = {"return": "Train/mean_reward", "success": "Train/success_rate"}
"""Name of a metric in tables and JSON documents -> its name in metrics.jsonl."""


class StudyView(AbstractContextManager[Any], Protocol):
    """Display of the progress of a study's runs, used in a `with` block.

    A study is one configuration that is trained with several seeds.
    """

    def poll(self) -> None:
        """Update the display, unless it was updated a moment ago."""


@dataclass(slots=True)
class StudyResult:
    """Result of a study (one configuration trained with several seeds) at the end of `train_seeds`."""

    folder: Path
    task: str
    runs: list[dict[str, Any]]
    """The seed, the state and the last metrics of each run."""
    together: dict[str, Any] | None = None
    """Metric (`return`, `success`) -> last interquartile mean over the seeds (`iqm`), its interval (`low`, `high`) and
    the number of environment steps (`step`); None if no run has metrics."""
    curves: Path | None = None
    """CSV file with the learning curves; None: not written."""
    picture: Path | None = None
    """Picture of the learning curves; None: not written."""
    exit_code: int = 0
    """Exit code of the first training that failed; 0 if no training has failed."""
    stop_code: int | None = None
    """Exit code for the signal that stopped the study before its end; None: not stopped."""


def new_study(request: TrainingRequest, resolved: Resolved, device: str, seeds: Sequence[int]) -> Path:
    """Create and return the folder of a study, with a run for each seed; the trainings are not started.

    Args:
        request: the request for the trainings.
        resolved: the configuration of all runs.
        device: torch device of the trainings.
        seeds: the seeds.
    """
    record, config = run_record(request, resolved, device), to_yaml(to_data(resolved))
    folder = create_study(request.runs, resolved.source.name, request.name, config, record, seeds)
    _log.info("study %s: seeds %s", folder, ", ".join(map(str, seeds)))
    return folder


def resume_options(request: TrainingRequest) -> list[str]:
    """Return the options of `rlcli train` (such as --max-steps) that apply to each run of a resumed study."""
    values = {
        "--max-iterations": request.budget.get("agent.max_iterations"),
        "--max-steps": request.budget.get("agent.max_steps"),
        "--max-minutes": request.budget.get("agent.max_minutes"),
        "--until": request.budget.get("agent.until"),
        "--video-every": request.video_every,
    }
    options = [word for option, value in values.items() if value is not None for word in (option, str(value))]
    return options + [word for name in request.loggers or [] for word in ("--logger", name)]


def train_seeds(
    folder: Path,
    device: str | None,
    jobs: int,
    stop: StopRequest,
    make_view: Callable[[str, Sequence[Path]], StudyView],
    finished_too: bool = False,
    options: Sequence[str] = (),
) -> StudyResult:
    """Train the unfinished runs of a study, and write the aggregated curves.

    Args:
        folder: folder of the study.
        device: device of the trainings; None: the device of the study.
        jobs: number of trainings at a time.
        stop: stores whether a signal has requested a stop; signals are handled while the trainings run.
        make_view: returns the display of the progress, for a title and the folders of the runs.
        finished_too: whether finished runs are continued too, because they have a new budget.
        options: further options of each `rlcli train --resume`, see `resume_options`.

    Raises:
        CheckpointError: if the study cannot be read.
    """
    study = read_study(folder)
    runs = runs_of(folder, study)
    with stop:
        unfinished = [run for run in runs if finished_too or overview(run).state != "finished"]
        with make_view(f"rlcli train {study['task']}", runs) as view:
            ended = train_all(unfinished, device or str(study.get("device", "cpu")), jobs, options, stop, view.poll)
    result = _summary(folder, study["task"], runs)
    result.exit_code = next((one.exit_code for one in ended if one.exit_code and not one.stop_requested), 0)
    if stop.signal is not None and any(overview(run).state != "finished" for run in runs):
        result.stop_code = stop.exit_code
    return result


def _summary(folder: Path, task: str, runs: Sequence[Path]) -> StudyResult:
    """Write the learning curves over all seeds (CSV, picture); return the study's result.

    `task` is the name of the task, `runs` are the folders of the runs.
    """
    rows: list[dict[str, Any]] = []
    for run in map(overview, runs):
        row = {"seed": run.seed, "run": str(run.folder), "state": run.state, "step": run.step}
        rows.append({**row, "trained_s": run.duration_s, **run.last})
    result = StudyResult(folder, task, rows)
    try:
        curves, notes = gather([open_run(run) for run in runs])
    except CheckpointError as error:
        _log.warning("%s", error.message)
        return result
    for note in notes:
        _log.warning("%s", note)
    lines = {name: curves[0].line(metric) for name, metric in METRICS.items()}
    found = {name: line for name, line in lines.items() if line is not None}
    result.together = {}
    for name, line in found.items():
        _, middle, low, high = line.last()
        result.together[name] = {"iqm": middle, "low": low, "high": high, "step": int(line.x[-1])}
    if found:
        result.curves = write_atomic(folder / CURVES, _csv(found))
        result.picture = _picture(folder, curves)
    return result


def _csv(lines: dict[str, Line]) -> str:
    """Return CSV with the columns `steps` and NAME, NAME_low, NAME_high (interquartile mean, interval) of each metric.

    `lines` maps the name of a metric to its curve. The steps are those of the first curve; other curves are
    interpolated.
    """
    import numpy as np

    text = [",".join(["steps", *(f"{name}{end}" for name in lines for end in ("", "_low", "_high"))])]
    axis = next(iter(lines.values())).x
    columns = [
        np.full(len(axis), np.nan) if values is None else np.interp(axis, line.x, values)
        for line in lines.values()
        for values in (line.middle, line.low, line.high)
    ]
    for steps, *row in zip(axis, *columns, strict=True):
        text.append(",".join([f"{int(steps)}", *("" if np.isnan(value) else f"{value:.6g}" for value in row)]))
    return "\n".join(text) + "\n"


def _picture(folder: Path, curves: list[Curve]) -> Path | None:
    """Plot the learning curves over all seeds into the study's folder; return the file.

    None: matplotlib is not installed, or no metric can be plotted.
    """
    try:
        check_drawing()
    except DependencyError:
        return None
    panels = choose(curves, list(METRICS), "steps")
    if not panels:
        return None
    drawn = picture(panels, AXES["steps"], ".svg", title=curves[0].label, note="")
    return write_atomic(folder / PICTURE, drawn)

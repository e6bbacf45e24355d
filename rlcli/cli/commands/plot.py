"""Command `rlcli plot`: picture with the learning curves of runs.

Runs that differ only in their seed become one curve, with a confidence interval.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.ui.completion import runs_and_tasks
from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import RunsDir, check_output, choice
from rlcli.errors import MachineError, UsageError, require_known

if TYPE_CHECKING:
    from rlcli.reporting.curve_panels import Panel
    from rlcli.reporting.curves import Curve
    from rlcli.runs.run import Run

_CURVES = Path("curves.png")
_MAX_PANELS = 60
"""Largest number of panels in one figure."""


def command(
    runs: Annotated[list[str], typer.Argument(autocompletion=runs_and_tasks, metavar="RUN")],
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FILE")] = None,
    metrics: Annotated[str | None, typer.Option(metavar="NAMES")] = None,
    x: Annotated[str, choice("AXIS", "steps", "iterations", "time")] = "steps",
    runs_dir: RunsDir = None,
) -> None:
    """Plot learning curves of runs. Several seeds become their interquartile mean with a 95 % interval.

    Options:
        runs: Runs by folder or name, latest, or a task: all of its runs.
        output: File to write, FILE.png, .svg or .pdf. [default: plots/curves.png in a single run, else curves.png]
        metrics: Names separated by commas: return, success, length, rewards, terminations, a metric of the runs
            (Loss/value), or a group of metrics (Loss). [default: return, success, length, rewards, terminations]
        x: Quantity on the x axis: steps, iterations or time (of training [s]).

    Examples:
        rlcli plot latest
            Plot the curves of the newest run into its folder.
        rlcli plot cartpole --metrics return,Loss -o curves.svg
            Plot the return and the losses of all runs of cartpole.
    """
    from rlcli.reporting.matplotlib_plots import FORMATS, check_drawing
    from rlcli.runs.run_ref import default_runs_dir, find_runs

    require_known(x, ("steps", "iterations", "time"), "--x", "axes")
    names = None if metrics is None else [name.strip() for name in metrics.split(",") if name.strip()]
    if names == []:
        raise UsageError("--metrics names no metric", hint="for example: --metrics return,success")
    check_output(output, "picture", FORMATS)
    check_drawing()
    found = find_runs(runs, runs_dir or default_runs_dir())

    from rlcli.reporting.curves import gather

    curves, notes = gather(found)
    for note in notes:
        console.warn(note)
    panels, file = _choose_panels(curves, names, x), output or _default_file(found)
    _draw(file, curves, panels, x)
    console.data(str(file))
    console.document(
        "plot",
        file=str(file),
        x=x,
        panels=[panel.title for panel in panels],
        curves=[_record(curve, x) for curve in curves],
        notes=notes,
    )


def _choose_panels(curves: list[Curve], names: list[str] | None, x: str) -> list[Panel]:
    from rlcli.reporting.curve_panels import choose

    panels = choose(curves, names, x)
    if not panels:
        raise UsageError("nothing to plot: no episode has ended yet", hint="--metrics Loss plots the losses")
    if len(panels) > _MAX_PANELS:
        console.warn(f"plotting the first {_MAX_PANELS} of {len(panels)} panels; choose others with --metrics")
    return panels[:_MAX_PANELS]


def _draw(file: Path, curves: list[Curve], panels: list[Panel], x: str) -> None:
    """Write the picture of the learning curves, and print the seeds of each curve."""
    from rlcli.reporting.curves import AXES
    from rlcli.reporting.matplotlib_plots import picture
    from rlcli.runs.atomic_io import write_atomic

    note = _note(curves)
    write_atomic(file, picture(panels, AXES[x], file.suffix.lower(), title=_title(curves), note=note))
    for curve in curves:
        seeds = ", ".join(map(str, curve.seeds))
        console.info(f"{curve.label}: seed{'s' * (len(curve.seeds) > 1)} {seeds}")
    if note:
        console.info(note)


def _default_file(runs: list[Run]) -> Path:
    from rlcli.runs.run import require_own

    if len(runs) > 1:
        return _CURVES
    file = runs[0].folder / "plots" / _CURVES
    require_own(runs[0], "plots")
    try:
        file.parent.mkdir(exist_ok=True)
    except OSError as error:
        raise MachineError(
            f"cannot write {file}: {error.strerror or error}", hint="give another file: -o FILE.png"
        ) from None
    return file


def _title(curves: list[Curve]) -> str:
    if len(curves) == 1:
        return curves[0].label
    return ", ".join(dict.fromkeys(str(h.run.record["task"]["name"]) for curve in curves for h in curve.histories))


def _note(curves: list[Curve]) -> str:
    from rlcli.reporting.curves import FEWEST_FOR_IQM

    if all(len(curve.histories) == 1 for curve in curves):
        return ""
    count = FEWEST_FOR_IQM
    few = f"fewer than {count} seeds: mean; " if any(1 < len(curve.histories) < count for curve in curves) else ""
    return (
        f"Lines: interquartile mean of the seeds ({few}terminations: mean). Bands: 95 % stratified bootstrap "
        "interval (Agarwal et al. 2021)."
    )


def _record(curve: Curve, axis: str) -> dict[str, Any]:
    """Return a curve as JSON data: its runs, and the last value of each metric over an axis."""
    ends = {}
    for name in curve.names():
        line = curve.line(name, axis)
        if line is not None:
            ends[name] = dict(zip(("x", "value", "low", "high"), line.last(), strict=True))
    runs = [{"folder": str(h.run.folder), "seed": h.run.record["seed"]} for h in curve.histories]
    return {"label": curve.label, "runs": runs, "last": ends}

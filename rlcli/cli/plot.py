"""`rlcli plot`: learning curves of runs, those that differ in their seed only taken together."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.completion import runs_and_tasks
from rlcli.cli.console import console
from rlcli.cli.options import Debug, Json, Quiet, RunsDir, Verbose

if TYPE_CHECKING:
    from rlcli.rl.curves import Curve
    from rlcli.rl.run import Run

_MANY = Path("curves.png")
_MOST_PANELS = 60
"""Of one picture."""


def command(
    runs: Annotated[
        list[str],
        typer.Argument(
            autocompletion=runs_and_tasks,
            metavar="RUN",
            help="Runs by folder or name, latest, or a task: all of its runs.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help="FILE.png, .svg or .pdf; by default RUN/plots/curves.png of one run, curves.png of several.",
        ),
    ] = None,
    metrics: Annotated[
        str | None,
        typer.Option(
            "--metrics",
            help="return, success, length, rewards, terminations, any metric of the runs (Loss/value), or what stands "
            "before its slash (Loss); separated by commas.",
        ),
    ] = None,
    x: Annotated[str, typer.Option("--x", help="steps, iterations or time (of training, in seconds).")] = "steps",
    runs_dir: RunsDir = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Draw learning curves. Of several seeds their interquartile mean and its 95 % interval."""
    from rlcli.errors import UsageError, did_you_mean
    from rlcli.rl.figures import FORMATS, check_drawing
    from rlcli.rl.run import default_runs_dir

    axes = ("steps", "iterations", "time")
    if x not in axes:
        raise UsageError(f"no --x '{x}'", hint=did_you_mean(x, axes) or f"axes: {', '.join(axes)}")
    if output is not None and output.suffix not in FORMATS:
        raise UsageError(f"'{output}' is not a picture", hint=f"name it *{', *'.join(FORMATS)}")
    names = None if metrics is None else [name.strip() for name in metrics.split(",") if name.strip()]
    if names == []:
        raise UsageError("--metrics names none", hint="--metrics return,success")
    require_folder(output)
    check_drawing()
    found = find_runs(runs, runs_dir or default_runs_dir())

    from rlcli.rl.curves import AXES, gather
    from rlcli.rl.figures import picture
    from rlcli.rl.files import write_atomic
    from rlcli.rl.panels import choose

    curves, notes = gather(found)
    for note in notes:
        console.warn(note)
    panels = choose(curves, names, x)
    if not panels:
        raise UsageError("there is nothing to draw: no episode has ended yet", hint="--metrics Loss draws the losses")
    if len(panels) > _MOST_PANELS:
        console.warn(f"the first {_MOST_PANELS} of {len(panels)} panels are drawn; --metrics chooses")
    panels = panels[:_MOST_PANELS]
    file = output or _default_file(found)
    write_atomic(file, picture(panels, AXES[x], file.suffix, title=_title(curves), note=_note(curves)))
    _tell(curves)
    console.data(str(file))
    console.document(
        "plot",
        file=str(file),
        x=x,
        panels=[panel.title for panel in panels],
        curves=[_document(curve, x) for curve in curves],
        notes=notes,
    )


def require_folder(output: Path | None) -> None:
    """Refuse a file that cannot be written before anything is done for it.

    Raises:
        UsageError: for a folder.
        MachineError: if its folder is not there.
    """
    from rlcli.errors import MachineError, UsageError

    if output is not None and output.is_dir():
        raise UsageError(f"-o {output} is a folder", hint="give a file")
    if output is not None and not output.absolute().parent.is_dir():
        raise MachineError(f"cannot write {output}: there is no folder {output.absolute().parent}")


def find_runs(references: list[str], runs_dir: Path) -> list[Run]:
    """Runs as a command line names them: a folder, a name, `latest`, a task, or a folder of runs.

    Raises:
        CheckpointError: if one names nothing.
    """
    from rlcli.rl.run import RECORD, find_run, list_runs

    found: list[Run] = []
    for reference in references:
        folder = Path(reference)
        if not (folder / RECORD).is_file() and reference != "latest":
            of_task = list_runs(runs_dir, reference.rpartition(":")[2])
            if not of_task and folder.is_dir():
                of_task = [
                    run for run in list_runs(folder.resolve().parent, None) if run.folder.parent.samefile(folder)
                ]
            if of_task:
                found += of_task
                continue
        run, why = find_run(reference, runs_dir)
        if reference == "latest":
            console.info(f"{run.folder} ({why})")
        found.append(run)
    return found


def _default_file(runs: list[Run]) -> Path:
    from rlcli.errors import MachineError
    from rlcli.rl.run import require_own

    if len(runs) > 1:
        return _MANY
    file = runs[0].folder / "plots" / _MANY
    require_own(runs[0], "plots")
    try:
        file.parent.mkdir(exist_ok=True)
    except OSError as error:
        raise MachineError(f"cannot write {file}: {error.strerror or error}", hint="-o FILE.png") from None
    return file


def _title(curves: list[Curve]) -> str:
    if len(curves) == 1:
        return curves[0].label
    return ", ".join(dict.fromkeys(str(h.run.record["task"]["name"]) for curve in curves for h in curve.histories))


def _note(curves: list[Curve]) -> str:
    if all(len(curve.histories) == 1 for curve in curves):
        return ""
    few = "of fewer than 4 their mean; " if any(1 < len(curve.histories) < 4 for curve in curves) else ""
    return (
        f"Lines: interquartile mean of the seeds ({few}terminations: mean). Bands: 95 % stratified bootstrap "
        "interval (Agarwal et al. 2021)."
    )


def _tell(curves: list[Curve]) -> None:
    for curve in curves:
        seeds = ", ".join(map(str, curve.seeds))
        console.info(f"{curve.label}: seed{'s' * (len(curve.seeds) > 1)} {seeds}")
    if _note(curves):
        console.info("of several seeds: interquartile mean and 95 % bootstrap interval (Agarwal et al. 2021)")


def _document(curve: Curve, axis: str) -> dict[str, Any]:
    """A curve in numbers: where each metric ended."""
    ends = {}
    for name in curve.names():
        line = curve.line(name, axis)
        if line is None:
            continue
        known = line.low is not None and line.high is not None
        ends[name] = {
            "x": float(line.x[-1]),
            "value": float(line.middle[-1]),
            "low": float(line.low[-1]) if known else None,  # type: ignore[index]
            "high": float(line.high[-1]) if known else None,  # type: ignore[index]
        }
    runs = [{"folder": str(h.run.folder), "seed": h.run.record["seed"]} for h in curve.histories]
    return {"label": curve.label, "runs": runs, "last": ends}

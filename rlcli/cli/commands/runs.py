"""Command `rlcli runs`: table of the runs in a folder, with their state, progress and score.

The values are read from the files of the runs; thousands of runs take little time.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.ui.completion import tasks
from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import RunsDir
from rlcli.cli.ui.tables import cell
from rlcli.errors import did_you_mean, listing
from rlcli.safe_text import shorten

if TYPE_CHECKING:
    from rlcli.runs.overview import Overview

_COLUMNS = [
    "RUN", "STATE", "PROGRESS", "RETURN", "SUCCESS", "BEST", "EVAL", "AGE", "TRAINED", "SIZE", "AGENT", "SEED",
    "REMARK",
]  # fmt: skip
_MAX_REMARK = 60
"""Largest length of a text in the column REMARK [characters]."""


def command(
    task: Annotated[str | None, typer.Argument(autocompletion=tasks, metavar="TASK")] = None,
    limit: Annotated[int | None, typer.Option(min=1)] = None,
    runs_dir: RunsDir = None,
) -> None:
    """List runs with their state, progress and score, newest first.

    Options:
        task: List only runs of this task: its name or its folder. [default: all tasks]
        limit: List only the newest runs. [default: all]

    Examples:
        rlcli runs
            List all runs.
        rlcli runs cartpole --limit 5
            List the five newest runs of cartpole.
    """
    from rlcli.runs.overview import overviews
    from rlcli.runs.run_ref import default_runs_dir

    folder = runs_dir or default_runs_dir()
    found = overviews(folder)
    wanted = None if task is None else Path(task).resolve().name if "/" in task else task.rpartition(":")[2]
    chosen = [run for run in found if wanted in (None, run.task)]
    listed = chosen[:limit]
    console.document("runs", runs_dir=str(folder), count=len(chosen), runs=[run.document() for run in listed])
    if not chosen:
        tasks = sorted({run.task for run in found})
        near = (wanted and did_you_mean(wanted, tasks)) or (f"there are runs of {listing(tasks)}" if tasks else "")
        console.info(f"no run{f' of {wanted}' if wanted else ''} in {folder}" + (f"; {near}" if near else ""))
        return
    console.table(_COLUMNS, [_row(run, folder) for run in listed])
    if len(listed) < len(chosen):
        console.info(f"older runs that are not shown: {len(chosen) - len(listed)}")


def _row(run: Overview, runs_dir: Path) -> list[str]:
    from rlcli.cli.ui.progress_view import duration_text

    folder = run.folder.relative_to(runs_dir) if run.folder.is_relative_to(runs_dir) else run.folder
    resumable = run.resumable and run.state in ("interrupted", "stopped", "diverged", "failed")
    if run.state == "broken":
        return [str(folder), run.state, *["-"] * 7, size_text(run.size_bytes), "-", "-", _one_line(run.reason or "")]
    total = "?" if run.iterations is None else run.iterations
    return [
        str(folder),
        run.state + (": resumable" if resumable else ""),
        f"{run.iteration or 0}/{total}",
        cell(run.last.get("return"), ".4g"),
        cell(run.last.get("success"), ".1%"),
        _best(run.best),
        _best(run.evaluation),
        "-" if run.age_s is None else age_text(run.age_s),
        "-" if run.duration_s is None else duration_text(run.duration_s),
        size_text(run.size_bytes),
        _one_line(run.agent or "-"),
        cell(run.seed),
        _one_line(run.reason or "") or _tags(run),
    ]


def _tags(run: Overview) -> str:
    """Return the text of a run's column REMARK.

    The text names the device unless the device is the CPU, and the number of processes if there are several. It ends
    with `from weights` if the training started with the weights of a checkpoint (--init-from).
    """
    tags = []
    if (device := str(run.tags.get("device", "cpu"))) != "cpu":
        tags.append(device)
    if run.tags.get("processes", 1) != 1:
        tags.append(f"{run.tags['processes']} processes")
    if run.tags.get("init_from"):
        tags.append("from weights")
    return _one_line(", ".join(tags))


def _best(best: dict[str, float]) -> str:
    return cell(best["success"], ".1%") if "success" in best else cell(best.get("return"), ".4g")


def _one_line(text: str) -> str:
    return shorten(" ".join(text.split()), _MAX_REMARK, "…")


def age_text(seconds: float) -> str:
    """Return a duration [s] as text in its largest unit, such as `3 d` or `5 min`."""
    for unit, length in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"


def size_text(count: int) -> str:
    """Return a number of bytes with a unit, as `1.5 MB`."""
    value = float(count)
    for unit in ("B", "kB", "MB", "GB"):
        if value < 1000 or unit == "GB":
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    raise AssertionError("bug in rlcli: no unit is large enough")

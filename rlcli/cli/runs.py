"""`rlcli runs`: what became of the runs of a folder, newest first."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.completion import tasks
from rlcli.cli.console import console
from rlcli.cli.options import Debug, Json, Quiet, RunsDir, Verbose

if TYPE_CHECKING:
    from rlcli.rl.overview import Overview

_COLUMNS = [
    "RUN", "STATE", "PROGRESS", "RETURN", "SUCCESS", "BEST", "EVAL", "AGE", "TRAINED", "SIZE", "AGENT", "SEED",
    "REMARK",
]  # fmt: skip
_LONGEST = 60


def command(
    task: Annotated[
        str | None, typer.Argument(autocompletion=tasks, help="Only runs of this task: its name, or its folder.")
    ] = None,
    limit: Annotated[int | None, typer.Option("--limit", min=1, help="Only the N newest.")] = None,
    runs_dir: RunsDir = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """List runs: their state, progress and score."""
    from rlcli.errors import did_you_mean, listing
    from rlcli.rl.overview import overviews
    from rlcli.rl.run import default_runs_dir

    place = runs_dir or default_runs_dir()
    found = overviews(place)
    wanted = None if task is None else Path(task).resolve().name if "/" in task else task.rpartition(":")[2]
    chosen = [run for run in found if wanted in (None, run.task)]
    shown = chosen[:limit]
    console.document("runs", runs_dir=str(place), count=len(chosen), runs=[run.document() for run in shown])
    if not chosen:
        tasks = sorted({run.task for run in found})
        near = (wanted and did_you_mean(wanted, tasks)) or (f"there are runs of {listing(tasks)}" if tasks else "")
        console.info(f"no run{f' of {wanted}' if wanted else ''} in {place}" + (f"; {near}" if near else ""))
        return
    console.table(_COLUMNS, [_row(run, place) for run in shown])
    if len(shown) < len(chosen):
        console.info(f"{len(chosen) - len(shown)} older runs are not shown")


def _row(run: Overview, place: Path) -> list[str]:
    from rlcli.cli.live import clock

    folder = run.folder.relative_to(place) if run.folder.is_relative_to(place) else run.folder
    resumable = run.resumable and run.state in ("interrupted", "stopped", "diverged", "failed")
    if run.state == "broken":
        return [str(folder), run.state, *["-"] * 7, size(run.size_bytes), "-", "-", _cut(run.reason or "")]
    of = "?" if run.iterations is None else run.iterations
    return [
        str(folder),
        run.state + (": resumable" if resumable else ""),
        f"{run.iteration or 0}/{of}",
        _number(run.last.get("return")),
        _share(run.last.get("success")),
        _best(run.best),
        _best(run.evaluation),
        "-" if run.age_s is None else age(run.age_s),
        "-" if run.duration_s is None else clock(run.duration_s),
        size(run.size_bytes),
        _cut(run.agent or "-"),
        "-" if run.seed is None else str(run.seed),
        _cut(run.reason or "") or _tags(run),
    ]


def _tags(run: Overview) -> str:
    """What is not as it mostly is."""
    said = []
    if (device := str(run.tags.get("device", "cpu"))) != "cpu":
        said.append(device)
    if run.tags.get("processes", 1) != 1:
        said.append(f"{run.tags['processes']} processes")
    if run.tags.get("init_from"):
        said.append("from weights")
    return _cut(", ".join(said))


def _best(best: dict[str, float]) -> str:
    if not best:
        return "-"
    return _share(best["success"]) if "success" in best else _number(best.get("return"))


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"


def _cut(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= _LONGEST else f"{line[: _LONGEST - 1]}…"


def age(seconds: float) -> str:
    """A time in its largest unit."""
    for unit, length in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} s"


def size(count: int) -> str:
    """Bytes in a fitting unit."""
    value = float(count)
    for unit in ("B", "kB", "MB", "GB"):
        if value < 1000 or unit == "GB":
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1000
    raise AssertionError("the last unit takes all")

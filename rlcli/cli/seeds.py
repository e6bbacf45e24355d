"""`rlcli train TASK --seeds 0..4`: one configuration with several seeds, and what they say together."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.cli.console import console, is_terminal
from rlcli.cli.tables import flow, screen

if TYPE_CHECKING:
    from rlcli.cli.children import Child
    from rlcli.config.load import Resolved
    from rlcli.rl.stop import StopRequest

_LINE_EVERY_S = 10.0
CURVES = "curves.csv"
PICTURE = "curves.svg"
_TOLD = {"return": "Train/mean_reward", "success": "Train/success_rate"}


def create(
    resolved: Resolved, runs: Path, name: str | None, record: dict[str, Any], seeds: Sequence[int], **how: Any
) -> Path:
    """The folder of a new study; `how`: see `jobs.begun`."""
    from rlcli.cli.jobs import begun
    from rlcli.config.dump import to_data, to_yaml
    from rlcli.rl.study import create_study

    record = begun(resolved, runs, record, **how)
    folder = create_study(runs, resolved.source.name, name, to_yaml(to_data(resolved)), record, seeds)
    console.info(f"study {folder}: seeds {', '.join(map(str, seeds))}")
    return folder


def train_all(
    folder: Path, device: str | None, jobs: int, stop: StopRequest, *, longer: bool = False, words: Sequence[str] = ()
) -> None:
    """Train what is left of a study, then say what its seeds say together.

    Args:
        folder: the study.
        device: where; None is as it began.
        jobs: trainings at a time.
        stop: whether somebody asks to stop.
        longer: whether those that have finished have another budget now.
        words: options of `rlcli train --resume` that hold for each of them.

    Raises:
        Stopped: if somebody did.
        typer.Exit: with the exit code of the first training that went wrong.
    """
    import typer

    from rlcli.cli.children import run_all
    from rlcli.errors import Stopped
    from rlcli.rl.overview import overview
    from rlcli.rl.study import read_study, runs_of

    about = read_study(folder)
    runs = runs_of(folder, about)
    place = device or str(about.get("device", "cpu"))
    view = _View(f"rlcli train {about['task']}", runs)

    def tell(child: Child, ended: bool) -> None:
        if not ended:
            console.detail(f"{child.run.name} begins")
        elif child.exit_code and not child.asked:
            console.warn(f"{child.run.name}: {child.why}")

    with stop:
        left = [run for run in runs if longer or overview(run).state != "finished"]
        with view:
            ended = run_all(
                left, place, jobs, words=words, stopped=lambda: stop.signal is not None, tell=tell, look=view.look
            )
    wrong = [(run, child) for run, child in ended.items() if child.exit_code and not child.asked]
    asked = stop.signal is not None
    summary = _conclude(folder, runs)
    if asked and any(overview(run).state != "finished" for run in runs):
        raise Stopped("stopped on request", exit_code=stop.exit_code, hint=f"rlcli train --resume {folder} goes on")
    console.data(str(folder))
    state = "failed" if wrong else "finished"
    console.document("train", study=str(folder), task=about["task"], state=state, **summary)
    if wrong:
        raise typer.Exit(wrong[0][1].exit_code)


def _conclude(folder: Path, runs: Sequence[Path]) -> dict[str, Any]:
    """Write the curves of all seeds together; each seed's last numbers, and what they say together."""
    from rlcli.errors import CheckpointError
    from rlcli.rl.curves import gather
    from rlcli.rl.overview import overview
    from rlcli.rl.run import open_run
    from rlcli.rl.study import write_summary

    found = [overview(run) for run in runs]
    rows: list[dict[str, Any]] = [
        {
            "seed": one.seed,
            "run": str(one.folder),
            "state": one.state,
            "step": one.step,
            "trained_s": one.duration_s,
            **one.last,
        }
        for one in found
    ]
    try:
        curves, notes = gather([open_run(run) for run in runs])
    except CheckpointError as error:
        console.warn(error.message)
        return {"runs": rows, "curves": None, "together": {}}
    for note in notes:
        console.warn(note)
    curve = curves[0]
    together, columns = {}, {}
    for word, metric in _TOLD.items():
        line = curve.line(metric) if metric in curve.names() else None
        if line is None:
            continue
        columns[word] = line
        low, high = (None if end is None else float(end[-1]) for end in (line.low, line.high))
        together[word] = {"iqm": float(line.middle[-1]), "low": low, "high": high, "step": int(line.x[-1])}
    file = write_summary(folder, CURVES, _csv(columns)) if columns else None
    picture = _picture(folder, curves) if columns else None
    _show(rows, together)
    return {"runs": rows, "curves": file and str(file), "picture": picture, "together": together}


def _csv(lines: dict[str, Any]) -> str:
    """Steps, and of each metric the interquartile mean with its interval; a metric of its own length is cut to fit."""
    import numpy as np

    text = [",".join(["steps", *(f"{word}{end}" for word in lines for end in ("", "_low", "_high"))])]
    axis = next(iter(lines.values())).x
    columns = [
        np.full(len(axis), np.nan) if values is None else np.interp(axis, line.x, values)
        for line in lines.values()
        for values in (line.middle, line.low, line.high)
    ]
    text += [
        ",".join([f"{int(steps)}", *("" if value != value else f"{value:.6g}" for value in row)])
        for steps, *row in zip(axis, *columns, strict=True)
    ]
    return "\n".join(text) + "\n"


def _picture(folder: Path, curves: Any) -> str | None:
    """The curves as a picture, where matplotlib is installed."""
    from rlcli.errors import DependencyError
    from rlcli.rl.curves import AXES
    from rlcli.rl.figures import check_drawing, picture
    from rlcli.rl.panels import choose
    from rlcli.rl.study import write_summary

    try:
        check_drawing()
    except DependencyError:
        return None
    panels = choose(curves, ["return", "success"], "steps")
    if not panels:
        return None
    drawn = picture(panels, AXES["steps"], ".svg", title=curves[0].label, note="")
    return str(write_summary(folder, PICTURE, drawn))


def _show(rows: Sequence[dict[str, Any]], together: dict[str, Any]) -> None:
    table = []
    for row in rows:
        numbers = [f"{row[word]:.4g}" if word in row else "-" for word in _TOLD]
        table.append([str(row["seed"]), row["state"], f"{row['step'] or 0:,}", *numbers])
    for name, keys in (("IQM", ("iqm",)), ("95 %", ("low", "high"))):
        cells = [_ends([together.get(word, {}).get(key) for key in keys]) for word in _TOLD]
        table.append([name, "", "", *cells])
    console.table(["SEED", "STATE", "STEPS", "RETURN", "SUCCESS"], table)


def _ends(values: Sequence[float | None]) -> str:
    return "-" if any(value is None for value in values) else " .. ".join(f"{value:.4g}" for value in values)


class _View:
    """Where each seed stands: a live table on a terminal, a line now and then elsewhere."""

    def __init__(self, title: str, runs: Sequence[Path]) -> None:
        self._title, self._runs = title, runs
        self._live: Any = None
        self._last = time.monotonic()

    def __enter__(self) -> _View:
        if is_terminal(sys.stderr) and not console.quiet:
            from rich.live import Live

            self._live = Live(console=screen(sys.stderr), auto_refresh=False, transient=True)
            self._live.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        if self._live is not None:
            self._live.__exit__(*error)

    def look(self) -> None:
        now = time.monotonic()
        if now - self._last < (1.0 if self._live is not None else _LINE_EVERY_S) or console.quiet:
            return
        self._last = now
        from rlcli.rl.overview import overview

        seeds = [_told(overview(run)) for run in self._runs]
        if self._live is None:
            console.info("; ".join(map(" ".join, seeds)))
            return
        from rich.text import Text

        width = self._live.console.width
        lines = [self._title, *(line for said in seeds for line in flow(said, width))]
        self._live.update(Text("\n".join(lines)), refresh=True)


def _told(one: Any) -> list[str]:
    said = [f"seed {one.seed}", one.state]
    if one.iterations:
        said.append(f"{one.iteration or 0}/{one.iterations}")
    said += [f"{word} {one.last[word]:.4g}" for word in _TOLD if word in one.last]
    return said

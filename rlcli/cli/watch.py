"""`rlcli watch RUN`: the live table of a training in another terminal, read from the run's files."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.completion import runs
from rlcli.cli.console import console
from rlcli.cli.options import Debug, Json, Quiet, RunsDir, Verbose

if TYPE_CHECKING:
    from rlcli.rl.overview import Overview
    from rlcli.rl.progress import Progress
    from rlcli.rl.run import Run

_EVERY_S = 0.5


def command(
    reference: Annotated[
        str, typer.Argument(autocompletion=runs, metavar="RUN", help="A run's folder or name, or latest.")
    ] = "latest",
    runs_dir: RunsDir = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Follow a training from another terminal. Ctrl-C leaves it alone. --json says how it stands and ends."""
    from rlcli.errors import Stopped
    from rlcli.rl.run import default_runs_dir, find_run

    run, why = find_run(reference, runs_dir or default_runs_dir())
    if json:
        _document(run)
        return
    console.info(f"watching {run.folder} ({why})")
    try:
        seen = _follow(run)
    except KeyboardInterrupt:
        raise Stopped("no longer watching; the run is left alone", exit_code=130) from None
    _report(seen)


def _follow(run: Run) -> Overview:
    """Show the run until it ends: how it ended."""
    from rlcli.cli.live import TrainingView
    from rlcli.errors import CheckpointError
    from rlcli.rl.overview import overview_of, state_of
    from rlcli.rl.run import open_run

    shown = None
    with TrainingView(f"rlcli train {run.record['task']['name']}") as view:
        while True:
            state, _ = state_of(run)
            progress = _progress(run)  # what is written until the state was asked is seen
            if progress is not None and (progress.iteration, progress.env_steps) != shown:
                shown = progress.iteration, progress.env_steps
                view.show(progress)
            if state != "running":
                break
            time.sleep(_EVERY_S)
            try:
                run = open_run(run.folder)
            except CheckpointError:
                if not run.folder.exists():  # a run that never began is removed
                    raise
        return overview_of(open_run(run.folder))


def _progress(run: Run) -> Progress | None:
    from rlcli.rl.overview import count, newest_rows, times
    from rlcli.rl.progress import progress_of

    rows = newest_rows(run)
    if not rows:
        return None
    return progress_of(rows, count(run.record.get("iterations")), times(run)[1] or 0.0)


def _report(seen: Overview) -> None:
    of = "" if seen.iterations is None else f" of {seen.iterations}"
    console.data(f"{seen.folder}: {seen.state}, iteration {seen.iteration}{of}")
    if seen.reason:
        console.info(seen.reason)
    if seen.state != "finished" and seen.resumable:
        console.info(f"rlcli train --resume {seen.folder} goes on")


def _document(run: Run) -> None:
    from rlcli.rl.overview import overview_of

    said: dict[str, Any] = overview_of(run).document()
    progress = _progress(run)
    said |= {"steps_per_s": None, "remaining_s": None, "metrics": {}}
    if progress is not None:
        left = progress.remaining_s if said["state"] == "running" else None
        said |= {"steps_per_s": progress.steps_per_s, "remaining_s": left, "metrics": progress.metrics}
    console.document("watch", **said)

"""Command `rlcli watch`: live view of a training that runs in another terminal.

The command only reads the files of the run and does not disturb the training.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import RunRef, RunsDir

if TYPE_CHECKING:
    from rlcli.runs.overview import Overview
    from rlcli.runs.run import Run
    from rlcli.training.progress import Progress

_EVERY_S = 0.5


def command(
    reference: RunRef = "latest",
    runs_dir: RunsDir = None,
) -> None:
    """Show the progress of a training from another terminal. Ctrl-C ends only the view; --json prints the state once.

    Examples:
        rlcli watch
            Follow the newest run.
        rlcli watch 2026-01-31_12-00-00 --json
            Print the state of a run as JSON.
    """
    from rlcli.errors import Stopped
    from rlcli.runs.run_ref import default_runs_dir, find_run

    run, why = find_run(reference, runs_dir or default_runs_dir())
    if console.json:
        _document(run)
        return
    console.info(f"watching {run.folder} ({why})")
    try:
        final = _follow(run)
    except KeyboardInterrupt:
        raise Stopped("stopped watching; the training continues", exit_code=130) from None
    _report(final)


def _follow(run: Run) -> Overview:
    """Show the progress of a run until its training ends; return the final state."""
    from rlcli.cli.ui.progress_view import TrainingView
    from rlcli.errors import CheckpointError
    from rlcli.runs.overview import overview_of, state_of
    from rlcli.runs.run import open_run

    printed = None
    with TrainingView(f"rlcli train {run.record['task']['name']}") as view:
        while True:
            state, _ = state_of(run)
            progress = _progress(run)  # read after the state: if the run has ended, its last rows are written by now
            if progress is not None and (progress.iteration, progress.env_steps) != printed:
                printed = progress.iteration, progress.env_steps
                view.show(progress)
            if state != "running":
                break
            time.sleep(_EVERY_S)
            try:
                run = open_run(run.folder)
            except CheckpointError:
                if not run.folder.exists():  # rlcli removes the folder of a run whose setup fails
                    raise
        return overview_of(open_run(run.folder))


def _progress(run: Run) -> Progress | None:
    from rlcli.runs.overview import as_count, newest_rows
    from rlcli.training.progress import progress_from_metrics

    rows = newest_rows(run)
    if not rows:
        return None
    progress = progress_from_metrics(rows, as_count(run.record.get("iterations")))
    progress.notes = run.findings()
    return progress


def _report(final: Overview) -> None:
    total = "" if final.iterations is None else f" of {final.iterations}"
    console.data(f"{final.folder}: {final.state}, iteration {final.iteration}{total}")
    if final.reason:
        console.info(final.reason)
    if final.state != "finished" and final.resumable:
        console.info(f"rlcli train --resume {final.folder} continues the training")


def _document(run: Run) -> None:
    from rlcli.runs.overview import overview_of

    document: dict[str, Any] = overview_of(run).document()
    progress = _progress(run)
    document |= {"steps_per_s": None, "remaining_s": None, "metrics": {}}
    if progress is not None:
        left = progress.remaining_s if document["state"] == "running" else None
        document |= {"steps_per_s": progress.steps_per_s, "remaining_s": left, "metrics": progress.metrics}
    console.document("watch", **document)

"""`rlcli reproduce RUN`: is the environment what it was, and do the same bits come out of it again?"""

from __future__ import annotations

from typing import Annotated, Any

import typer

from rlcli.cli.completion import runs
from rlcli.cli.console import console
from rlcli.cli.options import Debug, Json, Quiet, RunsDir, Verbose


def command(
    reference: Annotated[
        str, typer.Argument(autocompletion=runs, metavar="RUN", help="A run's folder or name, or latest.")
    ],
    iterations: Annotated[
        int | None, typer.Option("--iterations", min=1, help="Train and compare only the first N iterations.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Go on where the environment is not what run.json records.")
    ] = False,
    name: Annotated[str, typer.Option("--name", help="Part of the new run folder's name.")] = "reproduced",
    runs_dir: RunsDir = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Train a run again, and compare."""
    from rlcli.cli.diff import report
    from rlcli.cli.live import TrainingView
    from rlcli.machine import available_cores, wait_calmly
    from rlcli.rl.environment import environment_record
    from rlcli.rl.load import resolve_run
    from rlcli.rl.run import default_runs_dir, find_run

    wait_calmly()  # as in training
    runs = runs_dir or default_runs_dir()
    original, why = find_run(reference, runs)
    console.info(f"reproducing {original.folder} ({why})")

    from rlcli.rl.compare import compare, reached
    from rlcli.rl.conduct import train_again
    from rlcli.rl.reproduction import changed, create_again, milestones, require_reproducible

    require_reproducible(original)
    last = reached(original)
    until = last if iterations is None else min(iterations, last)
    resolved = resolve_run(original, play=False)
    engine = resolved.task.sim.engine_threads or available_cores()
    now = environment_record(resolved, engine, int(original.record.get("torch_threads") or min(4, available_cores())))
    rows = changed(original, now)

    def accept(built: dict[str, Any]) -> None:
        more = changed(original, built)
        rows.extend(more)
        _require(more, force)

    _require(rows, force)
    if original.record.get("resumed"):
        console.warn("the run was resumed in another environment than it began in; its later bits may not come again")

    run, initial = create_again(original, runs, name, now)
    view = TrainingView(f"rlcli train {resolved.source.name}")
    step = train_again(run, resolved, initial, milestones(original, until), accept, view, console.warn)
    console.info(f"trained {until} of {last} iterations again in {run.folder}")
    sections = compare(original, run, sections=("metrics", "weights", "policy"), until=step)
    more = {"iterations": until, "environment": [_entry(row) for row in rows]}
    if not report("reproduce", sections, str(original.folder), str(run.folder), **more):
        raise typer.Exit(9)


def _require(rows: list[tuple[str, Any, Any]], force: bool) -> None:
    """Show what differs of the environment, and stop unless told to go on."""
    from rlcli.cli.diff import shown

    if not rows:
        return
    console.table(["ENVIRONMENT", "THEN", "NOW"], [[shown(name), shown(was), shown(now)] for name, was, now in rows])
    if force:
        console.warn("the environment is not what it was: other bits are to be expected")
        return
    console.info("the environment is not what run.json records; --force trains nevertheless")
    console.document("reproduce", equal=False, first=None, trained=False, environment=[_entry(row) for row in rows])
    raise typer.Exit(9)


def _entry(row: tuple[str, Any, Any]) -> dict[str, Any]:
    return dict(zip(("name", "then", "now"), row, strict=True))

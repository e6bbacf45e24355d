"""`rlcli reproduce RUN`: is the environment what it was, and do the same bits come out of it again?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import RunRef, RunsDir

if TYPE_CHECKING:
    from pathlib import Path

    from rlcli.envs.vec_env import VecEnv
    from rlcli.runs.run import Run

Row = tuple[str, Any, Any]
"""A fact of the environment, what it was, and what it is now."""


def command(
    reference: RunRef,
    iterations: Annotated[
        int | None, typer.Option(min=1, help="Train and compare only the first N iterations.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Go on where the environment is not what run.json records.")
    ] = False,
    name: Annotated[str, typer.Option(help="Part of the new run folder's name.")] = "reproduced",
    runs_dir: RunsDir = None,
) -> None:
    """Train a run again, and compare."""
    from rlcli.cli.ui.difference_table import report_differences
    from rlcli.machine import limit_openmp_spinning
    from rlcli.runs.run_ref import default_runs_dir, find_run

    limit_openmp_spinning()  # as in training
    runs = runs_dir or default_runs_dir()
    original, why = find_run(reference, runs)
    console.info(f"reproducing {original.folder} ({why})")

    from rlcli.runs.reproduction import require_reproducible
    from rlcli.runs.run_diff import compare, last_iteration

    require_reproducible(original)
    last = last_iteration(original)
    until = last if iterations is None else min(iterations, last)
    run, env_steps, rows = _train_again(original, until, runs, name, force)
    console.info(f"trained {until} of {last} iterations again in {run.folder}")
    sections = compare(original, run, sections=("metrics", "weights", "policy"), until=env_steps)
    more = {"iterations": until, "environment": [_entry(row) for row in rows]}
    if not report_differences("reproduce", sections, str(original.folder), str(run.folder), **more):
        raise typer.Exit(9)


def _train_again(original: Run, until: int, runs: Path, name: str, force: bool) -> tuple[Run, int, list[Row]]:
    """Train the first iterations of a run again.

    Returns:
        The new run, its environment steps, and what differs of the environment.
    """
    from rlcli.cli.ui.progress_view import TrainingView
    from rlcli.machine import available_cores
    from rlcli.runs.provenance import built_record, environment_record
    from rlcli.runs.reproduction import changed_entries, create_reproduction, milestones
    from rlcli.runs.restore import resolve_run
    from rlcli.training.job import Job
    from rlcli.training.launch import setup_job
    from rlcli.training.signals import StopRequest

    resolved = resolve_run(original, play=False)
    engine = resolved.task.sim.engine_threads or available_cores()
    now = environment_record(resolved, engine, int(original.record.get("torch_threads") or min(4, available_cores())))
    rows = changed_entries(original, now)

    def check_model(env: VecEnv) -> None:
        more = changed_entries(original, built_record(env.engine.model, "cpu"))
        rows.extend(more)
        _require(more, force)

    _require(rows, force)
    if original.record.get("resumed"):
        console.warn("the run was resumed in another environment than it began in; its later bits may not come again")

    run, initial = create_reproduction(original, runs, name, now)
    job = Job(run, resolved, [], init_from=initial, stages=milestones(original, until))
    with StopRequest() as stop:
        trainer, env = setup_job(job, "cpu", stop, check_model)
        from rlcli.training.runner import run_training

        run_training(job, trainer, env, stop, TrainingView(f"rlcli train {resolved.source.name}"))
    return run, trainer.env_steps, rows


def _require(rows: list[Row], force: bool) -> None:
    """Show what differs of the environment, and stop unless told to go on."""
    from rlcli.cli.ui.difference_table import cell

    if not rows:
        return
    console.table(["ENVIRONMENT", "THEN", "NOW"], [[cell(name), cell(was), cell(now)] for name, was, now in rows])
    if force:
        console.warn("the environment is not what it was: other bits are to be expected")
        return
    console.info("the environment is not what run.json records; --force trains nevertheless")
    console.document("reproduce", equal=False, first=None, trained=False, environment=[_entry(row) for row in rows])
    raise typer.Exit(9)


def _entry(row: Row) -> dict[str, Any]:
    return dict(zip(("name", "then", "now"), row, strict=True))

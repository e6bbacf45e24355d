"""Command `rlcli reproduce`: repetition of a training, whose metrics and weights must equal those of the original run.

First the command compares the versions of software and the machine with those that the run has recorded.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import RunRef, RunsDir

if TYPE_CHECKING:
    from pathlib import Path

    from rlcli.envs.environment_protocol import Environment
    from rlcli.runs.run import Run

Row = tuple[str, Any, Any]
"""A name, such as `torch` or `cpu`, of a version or a property of the machine; its value in run.json; its value now."""


def command(
    reference: RunRef,
    iterations: Annotated[int | None, typer.Option(min=1)] = None,
    force: Annotated[bool, typer.Option("--force")] = False,
    name: Annotated[str, typer.Option()] = "reproduced",
    runs_dir: RunsDir = None,
) -> None:
    """Train a run again and compare metrics and weights bit by bit.

    Options:
        iterations: Train and compare only the first iterations. [default: all]
        force: Train even if versions, code or machine differ from those recorded in run.json.
        name: Text at the end of the new run folder's name.

    Examples:
        rlcli reproduce latest
            Train the newest run again and compare.
        rlcli reproduce latest --iterations 5 --force
            Compare five iterations, even if software or machine have changed.
    """
    from rlcli.cli.ui.difference_table import report_differences
    from rlcli.machine.processes import limit_openmp_spinning
    from rlcli.runs.run_ref import default_runs_dir, find_run

    limit_openmp_spinning()  # `rlcli train` also does this before it imports torch
    runs = runs_dir or default_runs_dir()
    original, why = find_run(reference, runs)
    console.info(f"reproducing {original.folder} ({why})")

    from rlcli.runs.reproduction import require_reproducible
    from rlcli.runs.run_diff import compare, last_iteration

    require_reproducible(original)
    last = last_iteration(original)
    until = last if iterations is None else min(iterations, last)
    run, env_steps, rows = _train_again(original, until, runs, name, force)
    console.info(f"trained {until} of {last} iterations again in {run.shown}")
    sections = compare(original, run, sections=("metrics", "weights", "policy"), until=env_steps)
    more = {"iterations": until, "environment": [_entry(row) for row in rows]}
    if not report_differences("reproduce", sections, str(original.folder), str(run.shown), **more):
        raise typer.Exit(9)


def _train_again(original: Run, until: int, runs: Path, name: str, force: bool) -> tuple[Run, int, list[Row]]:
    """Train the first iterations of a run again.

    Returns:
        The new run, the number of its environment steps, and the versions and machine properties that have changed.
    """
    from rlcli.cli.ui.progress_view import TrainingView
    from rlcli.machine.cores import available_cores
    from rlcli.runs.provenance import built_record, environment_record
    from rlcli.runs.recorded_task import resolve_run
    from rlcli.runs.reproduction import changed_entries, create_reproduction, milestones
    from rlcli.training.job import Job
    from rlcli.training.signals import StopRequest
    from rlcli.training.start_run import setup_job

    resolved = resolve_run(original, play=False)
    engine = resolved.task.sim.engine_threads or available_cores()
    now = environment_record(resolved, engine, int(original.record.get("torch_threads") or min(4, available_cores())))
    rows = changed_entries(original, now)

    def check_model(env: Environment) -> None:
        more = changed_entries(original, built_record(env.engine.model, "cpu"))
        rows.extend(more)
        _require_no_changes(more, force)

    _require_no_changes(rows, force)
    if original.record.get("resumed"):
        console.warn("the run was resumed with other software or on another machine; later iterations may differ")

    run, initial = create_reproduction(original, runs, name, now)
    job = Job(run, resolved, [], init_from=initial, stages=milestones(original, until))
    with StopRequest() as stop:
        trainer, env = setup_job(job, "cpu", stop, check_model)
        from rlcli.training.runner import run_training

        run_training(job, trainer, env, stop, TrainingView(f"rlcli train {resolved.source.name}"))
    return run, trainer.env_steps, rows


def _require_no_changes(rows: list[Row], force: bool) -> None:
    """If software or machine have changed, print the changes, and exit with code 9 unless `force` is set."""
    from rlcli.cli.ui.difference_table import cell

    if not rows:
        return
    console.table(["SOFTWARE, MACHINE", "THEN", "NOW"], [[cell(name), cell(was), cell(now)] for name, was, now in rows])
    if force:
        console.warn("software or machine have changed since the training: the weights may differ in their last bits")
        return
    console.info("software or machine differ from those recorded in run.json; --force trains anyway")
    console.document("reproduce", equal=False, first=None, trained=False, environment=[_entry(row) for row in rows])
    raise typer.Exit(9)


def _entry(row: Row) -> dict[str, Any]:
    return dict(zip(("name", "then", "now"), row, strict=True))

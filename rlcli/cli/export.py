"""`rlcli export`: a trained policy as one file for a robot, checked against the policy and, if asked, in MuJoCo."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from rlcli.cli.console import console
from rlcli.cli.options import CheckpointRef, Debug, Json, Quiet, RunsDir


def command(
    task: Annotated[
        str | None, typer.Argument(help="A task: its newest run is exported. Not needed with --checkpoint.")
    ] = None,
    checkpoint: CheckpointRef = None,
    format_: Annotated[str, typer.Option("--format", help="onnx, torch (a torch.export program) or numpy.")] = "onnx",
    output: Annotated[
        Path | None, typer.Option("--output", help="File to write; else RUN/exports/policy.onnx, .pt2 or .py.")
    ] = None,
    verify: Annotated[
        bool,
        typer.Option("--verify", help="Let the file drive plain MuJoCo; writes the model and run_policy.py beside it."),
    ] = False,
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="With --verify: how many to live through.")] = 64,
    runs_dir: RunsDir = None,
    json: Json = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Export a trained policy."""
    from rlcli.errors import UsageError
    from rlcli.rl.checkpoint import open_checkpoint
    from rlcli.rl.export import FORMATS, check_target, export
    from rlcli.rl.run import Run, default_runs_dir, require_own

    console.quiet = quiet
    if task is None and checkpoint is None:
        raise UsageError("export what?", hint="a TASK, or --checkpoint RUN|latest")
    check_target(format_, output)
    folder, run, why = _find(checkpoint or "latest", runs_dir or default_runs_dir(), task)
    if output is None:
        if run is None:
            raise UsageError(f"{folder} lies outside a run", hint="say where to write with --output FILE")
        require_own(Run(run), "exports")
        output = run / "exports" / f"policy{FORMATS[format_]}"
    console.info(f"checkpoint {folder} ({why})")
    saved, session = open_checkpoint(folder), None
    if verify:
        if run is None:
            raise UsageError(f"{folder} lies outside a run", hint="--verify needs the run's configuration")
        from rlcli.cli.closing import open_referee
        from rlcli.rl.export_bundle import require_room

        require_room(output)
        session = open_referee(Run(run), saved, task)
    done = export(saved, output, format_, None if session is None else session.deployment)
    console.info(
        f"equal to the policy on {done.observations} observations: difference {done.max_difference:.1e} at most"
    )
    closed: dict[str, Any] = {}
    if session is not None:
        from rlcli.cli.closing import close

        closed = close(session, saved, done.file, format_, episodes)
    console.data(str(done.file))
    console.document(
        "export",
        checkpoint=str(folder),
        format=format_,
        file=str(done.file),
        bytes=done.file.stat().st_size,
        observations=done.observations,
        max_difference=done.max_difference,
        metadata=done.metadata,
        verified=closed or None,
    )
    if closed and not closed["passed"]:
        raise typer.Exit(9)


def _find(reference: str, runs_dir: Path, task: str | None) -> tuple[Path, Path | None, str]:
    """A checkpoint, the run it lies in, and why it was chosen; a checkpoint folder needs no run around it."""
    from rlcli.cli.session import require_no_run
    from rlcli.registry import TASKS, find_entry
    from rlcli.rl.run import RECORD, find_checkpoint, list_runs

    folder = Path(reference)
    if (folder / "manifest.json").is_file():
        run = folder.resolve().parent.parent
        return folder, run if (run / RECORD).is_file() else None, "as named"
    if task is not None:
        given, is_folder = task, Path(task).is_dir()
        task = Path(task).resolve().name if is_folder else task.rpartition(":")[2]
        if reference == "latest" and not list_runs(runs_dir, task):
            require_no_run(given, runs_dir)
            if not is_folder:
                find_entry(TASKS, given, what="task")  # no run of it: if it is no task either, that is what to say
    found, folder, why = find_checkpoint(reference, runs_dir, task, tell=console.warn)
    return folder, found.folder, why

"""`rlcli export`: a trained policy as one file for a robot, checked against the policy and, if asked, in MuJoCo."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.completion import tasks, words
from rlcli.cli.console import console
from rlcli.cli.options import CheckpointRef, Debug, Json, Quiet, RunsDir, Verbose

if TYPE_CHECKING:
    from rlcli.rl.choice import Choice


def command(
    task: Annotated[
        str | None,
        typer.Argument(
            autocompletion=tasks,
            help="A task: its newest run is exported, else the policy it ships. Not needed with --checkpoint.",
        ),
    ] = None,
    checkpoint: CheckpointRef = None,
    format_: Annotated[
        str,
        typer.Option(
            "--format",
            autocompletion=words("onnx", "torch", "numpy", "bundle"),
            help="onnx, torch (a torch.export program), numpy, or bundle (a folder for rlcli itself).",
        ),
    ] = "onnx",
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", help="File (or folder of a bundle) to write; else RUN/exports/policy.onnx, .pt2, .py or policy."
        ),
    ] = None,
    verify: Annotated[
        bool,
        typer.Option("--verify", help="Let the file drive plain MuJoCo; writes the model and run_policy.py beside it."),
    ] = False,
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="With --verify: how many to live through.")] = 64,
    runs_dir: RunsDir = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Export a trained policy."""
    from rlcli.errors import UsageError
    from rlcli.rl.checkpoint import open_checkpoint
    from rlcli.rl.export import BUNDLE, FORMATS, check_target, export
    from rlcli.rl.run import default_runs_dir, require_own

    if task is None and checkpoint is None:
        raise UsageError("export what?", hint="a TASK, or --checkpoint RUN|latest")
    check_target(format_, output)
    if format_ == BUNDLE and verify:
        raise UsageError("--verify is of the formats that do without rlcli", hint="--format onnx, torch or numpy")
    choice = _find(checkpoint, runs_dir or default_runs_dir(), task)
    folder, run = choice.folder, choice.run
    if output is None:
        if run is None:
            raise UsageError(f"{folder} lies outside a run", hint="say where to write with --output FILE")
        require_own(run, "exports")
        output = run.folder / "exports" / f"policy{FORMATS.get(format_, '')}"
    console.info(f"checkpoint {folder} ({choice.why})")
    saved, session = open_checkpoint(folder), None
    if format_ == BUNDLE:
        _bundle(saved, run, output)
        return
    if verify:
        if run is None and choice.bundle is None:
            raise UsageError(f"{folder} lies outside a run", hint="--verify needs the run's configuration")
        from rlcli.cli.closing import open_referee
        from rlcli.rl.export_bundle import require_room

        require_room(output)
        session = open_referee(choice, saved, task)
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


def _bundle(saved: Any, run: Any, output: Path) -> None:
    """A folder for rlcli itself, with the evaluation that the run keeps of the checkpoint."""
    from rlcli.rl.bundle import check_bundle_target, write_bundle
    from rlcli.rl.evaluations import read_evaluation

    check_bundle_target(output)
    evaluation = None if run is None else read_evaluation(run, saved.folder.name)
    if run is not None and evaluation is None:
        console.info(f"the bundle will not say how good it is: rlcli eval --checkpoint {saved.folder} was not run")
    made = write_bundle(saved, output, run, evaluation)
    console.data(str(made.folder))
    console.document(
        "export",
        checkpoint=str(saved.folder),
        format="bundle",
        file=str(made.folder),
        bytes=sum(file.stat().st_size for file in made.folder.iterdir()),
        metadata=made.manifest,
    )


def _find(reference: str | None, runs_dir: Path, task: str | None) -> Choice:
    """A checkpoint and why it was chosen; a checkpoint folder needs no run around it.

    A task is only looked up where no run of it is found: what was trained can be exported without its code.
    """
    from rlcli.cli.session import task_named
    from rlcli.rl.bundle import is_bundle
    from rlcli.rl.choice import SHIPPED, Choice, choose
    from rlcli.rl.run import RECORD, find_checkpoint, list_runs, open_run

    folder = Path(reference or "latest")
    if (folder / "manifest.json").is_file() and not is_bundle(folder):
        run = folder.resolve().parent.parent
        return Choice(folder, "as named", open_run(run) if (run / RECORD).is_file() else None, None)
    name = task
    if task is not None:
        name = Path(task).resolve().name if Path(task).is_dir() else task.rpartition(":")[2]
        if reference == SHIPPED or (reference in (None, "latest") and not list_runs(runs_dir, name)):
            return choose(reference, runs_dir, task_named(task, runs_dir), tell=console.warn)
    if reference == SHIPPED or is_bundle(folder):
        named = None if task is None else task_named(task, runs_dir)
        return choose(reference, runs_dir, named, tell=console.warn)
    found, folder, why = find_checkpoint(reference or "latest", runs_dir, name, tell=console.warn)
    return Choice(folder, why, found, None)

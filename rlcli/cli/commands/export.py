"""Command `rlcli export`: conversion of a trained policy into one file that runs on a robot without rlcli.

With --verify the file also controls the robot in plain MuJoCo, and the result is compared with an evaluation.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import CheckpointRef, RunsDir, TaskOfPolicy, choice
from rlcli.errors import TaskError, UsageError, listing
from rlcli.registry.find import path_of

if TYPE_CHECKING:
    from rlcli.deploy.closed_loop import ReferenceEnv
    from rlcli.deploy.closed_loop_result import ClosedLoopResult
    from rlcli.deploy.export import Exported
    from rlcli.runs.checkpoint_reader import Checkpoint
    from rlcli.runs.policy_ref import Choice
    from rlcli.runs.run import Run

_MAX_KEYS = 10
"""Largest number of differing metadata keys that --verify prints (keys whose value differs from the task's value)."""


def command(
    task: TaskOfPolicy = None,
    checkpoint: CheckpointRef = None,
    format: Annotated[str, choice("FORMAT", "onnx", "torch", "numpy", "bundle")] = "onnx",
    output: Annotated[Path | None, typer.Option("-o", "--output")] = None,
    verify: Annotated[bool, typer.Option("--verify")] = False,
    episodes: Annotated[int, typer.Option(min=1)] = 64,
    runs_dir: RunsDir = None,
) -> None:
    """Export a trained policy to a file for a robot, or to a bundle for rlcli.

    Options:
        format: onnx, torch (a torch.export program), numpy, or bundle (a folder for rlcli).
        output: File to write, or folder of a bundle. [default: exports/policy.onnx, .pt2, .py or policy in the run]
        verify: Run the exported file in plain MuJoCo and compare it with the run's evaluation; also write the model
            and run_policy.py beside the file.
        episodes: Number of episodes of --verify.

    Examples:
        rlcli export cartpole --verify
            Export the newest policy of cartpole to ONNX and verify it.
        rlcli export --checkpoint latest@best --format numpy --output policy.py
            Export the best checkpoint of the newest run to one Python file.
    """
    from rlcli.deploy.export import BUNDLE, check_target, export
    from rlcli.runs.checkpoint_reader import open_checkpoint
    from rlcli.runs.run_ref import default_runs_dir

    if task is None and checkpoint is None:
        raise UsageError("no task or checkpoint given", hint="rlcli export TASK, or --checkpoint RUN|latest")
    check_target(format, output)
    if format == BUNDLE and verify:
        raise UsageError("--verify needs a format that runs without rlcli", hint="--format onnx, torch or numpy")
    chosen = _find(checkpoint, runs_dir or default_runs_dir(), task)
    file = output or _default_file(chosen, format)
    console.info(f"checkpoint {chosen.folder} ({chosen.why})")
    saved = open_checkpoint(chosen.folder)
    if format == BUNDLE:
        _export_bundle(saved, chosen.run, file)
        return
    reference = _open_reference(chosen, saved, file, task, episodes) if verify else None
    done = export(saved, file, format, None if reference is None else reference.deployment)
    _print_exported(done, verify)
    result = None if reference is None else _verify(reference, saved, done, format, episodes)
    entries = {"observations": done.observations, "max_difference": done.max_difference, "metadata": done.metadata}
    verified = None if result is None else result.record()
    _report(chosen.folder, format, done.file, done.file.stat().st_size, **entries, verified=verified)
    if result is not None and not result.holds:
        raise typer.Exit(9)


def _print_exported(done: Exported, verify: bool) -> None:
    """Print the largest difference between the actions of the exported file and of the policy.

    With `verify`, also warn of observation and action terms that run_policy.py cannot compute.
    """
    from rlcli.deploy.metadata import terms_of_task_code

    limit = f"difference <= {done.max_difference:.1e}"
    console.info(f"the exported file equals the policy on {done.observations} observations: {limit}")
    for sentence in terms_of_task_code(done.metadata) if verify else []:
        console.warn(sentence)


def _default_file(choice: Choice, format_: str) -> Path:
    from rlcli.deploy.export import FORMATS
    from rlcli.runs.run import require_own

    if choice.run is None:
        raise UsageError(
            f"the checkpoint {choice.folder} is not in the folder of a run",
            hint="give the file to write: --output FILE",
        )
    require_own(choice.run, "exports")
    return choice.run.folder / "exports" / f"policy{FORMATS.get(format_, '')}"


def _open_reference(choice: Choice, saved: Checkpoint, file: Path, task: str | None, episodes: int) -> ReferenceEnv:
    from rlcli.deploy.closed_loop import open_reference
    from rlcli.deploy.run_policy_files import check_overwrites
    from rlcli.runs.trusted_tasks import named_task

    if choice.run is None and choice.bundle is None:
        raise UsageError(
            f"the checkpoint {choice.folder} is not in the folder of a run",
            hint="--verify needs a run: --checkpoint RUN",
        )
    check_overwrites(file)
    try:
        named = None if task is None else named_task(task)
    except TaskError as error:
        if choice.run is None or error.message != f"no task '{task}'":
            raise
        hint = f"leave out the task, which the run names: rlcli export --checkpoint {choice.run.folder} --verify"
        raise TaskError(error.message, hint=hint) from None
    return open_reference(choice, saved, named, episodes)


def _verify(
    reference: ReferenceEnv, saved: Checkpoint, exported: Exported, format_: str, episodes: int
) -> ClosedLoopResult:
    """Run the exported file in plain MuJoCo, and print the comparison with the run's evaluation."""
    from rlcli.deploy.closed_loop import verify

    result = verify(reference, saved, exported, format_, episodes)
    for source, terms in (("formulas of the metadata", result.by_metadata), ("the task's code", result.by_task)):
        if terms:
            console.info(f"terms that are computed by {source}: {', '.join(terms)}")
    if any(term.startswith("force ") for term in result.by_task):
        console.info(
            f"{result.program.name} applies no forces: they belong to the environment's code; compute them in your"
            " program and write them to the MjData before each mj_step"
        )
    rows = [
        [name, f"{found:.2e}", f"{allowed:g}", "holds" if held else "FAILS"]
        for name, found, allowed, held in result.rows()
    ]
    console.table(["", "FOUND", "ALLOWED", ""], rows)
    if result.differing:
        console.info(f"the exported file and the task differ in {listing(result.differing[:_MAX_KEYS])}")
    console.info(
        f"{result.episodes} episodes, mean return {result.plain_return:.6g} in plain MuJoCo,"
        f" {result.evaluation_return:.6g} in the run's evaluation"
    )
    if result.synchronized_return is not None:
        console.info(
            f"observations and actions agree, but returns differ by {result.return_difference:.2%}: rounding errors"
            " grow chaotically; re-synchronised after every step, the mean return is"
            f" {result.synchronized_return:.6g}, and the states disagree after {result.disagreeing_steps} steps"
        )
    return result


def _report(checkpoint: Path, format_: str, file: Path, size: int, **entries: Any) -> None:
    console.data(str(file))
    console.document("export", checkpoint=checkpoint, format=format_, file=file, bytes=size, **entries)


def _export_bundle(saved: Checkpoint, run: Run | None, output: Path) -> None:
    """Write a bundle: a folder with the policy for rlcli on another machine, and the checkpoint's saved evaluation."""
    from rlcli.runs.eval_store import read_evaluation
    from rlcli.runs.policy_bundle import check_bundle_target, write_bundle

    check_bundle_target(output)
    evaluation = None if run is None else read_evaluation(run, saved.folder.name)
    if run is not None and evaluation is None:
        console.info(f"the bundle contains no evaluation: `rlcli eval --checkpoint {saved.folder}`, then export again")
    bundle = write_bundle(saved, output, run, evaluation)
    size = sum(file.stat().st_size for file in bundle.folder.iterdir())
    _report(saved.folder, "bundle", bundle.folder, size, metadata=bundle.manifest)


def _find(reference: str | None, runs_dir: Path, task: str | None) -> Choice:
    """Return the checkpoint or bundle to export, with the reason for the choice. The folder may be outside of a run.

    The code of the task is imported only for a shipped policy, a bundle, or a task without a run: the checkpoints of
    runs are exported without this code.

    Args:
        reference: value of --checkpoint; None: the newest run, or the policy that `task` ships if it has no run.
        runs_dir: the folder of runs.
        task: name or folder of a task: only its runs are searched; None: the runs of all tasks.
    """
    from rlcli.evaluation.session import named_task_or_run
    from rlcli.runs.policy_bundle import is_bundle
    from rlcli.runs.policy_ref import SHIPPED, Choice, choose
    from rlcli.runs.run import RECORD, open_run
    from rlcli.runs.run_ref import find_checkpoint, list_runs

    folder = path_of(reference or "latest")
    if (folder / "manifest.json").is_file() and not is_bundle(folder):
        run = folder.resolve().parent.parent
        return Choice(folder, "as named", open_run(run) if (run / RECORD).is_file() else None, None)
    name = None
    if task is not None:
        name = Path(task).resolve().name if path_of(task).is_dir() else task.rpartition(":")[2]
    without_run = task is not None and reference in (None, "latest") and not list_runs(runs_dir, name)
    if reference == SHIPPED or is_bundle(folder) or without_run:
        return choose(reference, runs_dir, None if task is None else named_task_or_run(task, runs_dir))
    found, folder, why = find_checkpoint(reference or "latest", runs_dir, name)
    return Choice(folder, why, found, None)

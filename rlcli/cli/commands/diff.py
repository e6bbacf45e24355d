"""Command `rlcli diff`: comparison of two runs or of two configurations.

For two runs the command prints where they first differ, for two configurations all differences.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.ui.completion import runs_and_tasks
from rlcli.cli.ui.console import console
from rlcli.cli.ui.difference_table import report_differences
from rlcli.cli.ui.options import Agent, RunsDir, choice
from rlcli.errors import CheckpointError, TaskError, UsageError, did_you_mean, require_known
from rlcli.registry import TASKS, catalog, task_source
from rlcli.registry.find import path_of

if TYPE_CHECKING:
    from rlcli.config.load import Resolved
    from rlcli.runs.run import Run

Side = tuple[str, list[str]]
"""One side of the comparison: the run or task as it is typed, and the overrides that follow it."""


def command(
    words: Annotated[
        list[str],
        typer.Argument(autocompletion=runs_and_tasks, metavar="A [KEY.PATH=VALUE]... [B [KEY.PATH=VALUE]...]"),
    ],
    only: Annotated[
        list[str] | None, choice("PART", "configuration", "environment", "metrics", "weights", "policy")
    ] = None,
    agent: Agent = None,
    runs_dir: RunsDir = None,
) -> None:
    """Show the differences of two runs or configurations, each marked as physics, MDP, agent or cosmetic.

    Options:
        words: Each side is a run (RUN, RUN@step:N, RUN@best, a checkpoint folder, latest), or a task (a name, a
            folder, a YAML file) with its overrides. One task with overrides is compared with the task itself.
        only: Compare only this part of two runs: configuration, environment, metrics, weights or policy;
            repeatable.

    Examples:
        rlcli diff cartpole sim.dt=0.005
            Show what an override changes.
        rlcli diff latest 2026-01-31_12-00-00 --only metrics
            Find the first iteration in which the metrics of two runs differ.
    """
    from rlcli.runs.run_diff import SECTIONS
    from rlcli.runs.run_ref import default_runs_dir

    for name in only or []:
        require_known(name, SECTIONS, "--only", "parts")
    runs = runs_dir or default_runs_dir()
    left, right = _sides(words)
    one, other = _task(left, agent), _task(right, agent)
    try:
        if one is None and other is None:
            if agent is not None:
                raise UsageError("--agent applies to tasks; a run keeps the agent of its training: leave out --agent")
            equal = _compare_runs(left[0], right[0], runs, only)
        else:
            if only:
                raise UsageError("--only applies to two runs; a task has only a configuration: leave out --only")
            both = (one or _find(left[0], runs)[0], other or _find(right[0], runs)[0])
            equal = _compare_configurations(*both, left, right)
    except RecursionError:
        raise CheckpointError(
            f"a file of {left[0]} or {right[0]} is damaged: its data is nested too deeply; compare other runs"
        ) from None
    if not equal:
        raise typer.Exit(9)


def _sides(words: list[str]) -> tuple[Side, Side]:
    """Split the command line into the two sides to compare: (run or task, overrides) each."""
    sides: list[Side] = []
    for word in words:
        if "=" not in word or Path(word).exists():
            sides.append((word, []))
        elif sides:
            sides[-1][1].append(word)
        else:
            raise UsageError(f"the override '{word}' comes before any task", hint="rlcli diff TASK key.path=value")
    if len(sides) == 1 and sides[0][1]:
        sides.insert(0, (sides[0][0], []))
    if len(sides) != 2:
        found = f"found {len(sides)}: {', '.join(name for name, _ in sides)}"
        raise UsageError(f"expected two runs or tasks, {found}", hint="rlcli diff A B, or TASK key.path=value")
    return sides[0], sides[1]


def _task(side: Side, agent: str | None) -> Resolved | None:
    """Return the configuration of a task, resolved with the overrides of its side; None if the side is a run.

    Raises:
        UsageError: if overrides follow a run.
    """
    from rlcli.config.load import resolve
    from rlcli.runs.run import RECORD

    name, overrides = side
    path = path_of(name)
    installed = any(name in (entry.name, entry.qualified) for entry in catalog(TASKS)[0])
    is_run = not installed and ("@" in name or (path / RECORD).is_file() or (path / "manifest.json").is_file())
    if not is_run:
        try:
            return resolve(task_source(name), agent=agent, overrides=overrides)
        except TaskError:
            looks_like_task = installed or path.suffix in (".yaml", ".yml", ".py") or (path / "task.yaml").exists()
            if looks_like_task or (overrides and name != "latest"):
                raise
    if overrides:
        raise UsageError(f"{name} is a run; overrides apply only to tasks: leave out {' '.join(overrides)}")
    return None


def _compare_configurations(one: Resolved | Run, other: Resolved | Run, left: Side, right: Side) -> bool:
    """Print the differences of two configurations, in their values, model files and code.

    Args:
        one: configuration of a task, or a run.
        other: configuration or run to compare with `one`; `one` and `other` are not both runs.
        left: the words of the command line that name `one`.
        right: the words of the command line that name `other`.

    Returns:
        Whether the configurations are equal, except for cosmetic differences.
    """
    from rlcli.runs.config_diff import compare_files, compare_values, run_values, task_values
    from rlcli.runs.provenance import sources
    from rlcli.runs.run import Run

    values, files = [], []
    for side, opposite in ((one, other), (other, one)):
        found = run_values(side) if isinstance(side, Run) else task_values(side)
        if not isinstance(opposite, Run):  # a task has no seed to compare with
            found.pop(("seed",), None)
        values.append(found)
        digests = side.record.get("sources") if isinstance(side, Run) else sources(side)
        files.append({name: sha for name, sha in (digests or {}).items() if name != "rlcli"})
    sections = [compare_values(*values), compare_files(*files)]
    return report_differences("diff", sections, " ".join([left[0], *left[1]]), " ".join([right[0], *right[1]]))


def _compare_runs(left: str, right: str, runs: Path, only: list[str] | None) -> bool:
    from rlcli.runs.run_diff import SECTIONS, compare
    from rlcli.runs.run_ref import require_step

    one, step = _find(left, runs)
    other, other_step = _find(right, runs)
    if step is not None and other_step is not None and step != other_step:
        message = f"{left} is at step {step}, but {right} is at step {other_step}"
        raise UsageError(message, hint="compare checkpoints of the same step: RUN@step:N")
    until = step if step is not None else other_step
    if until is not None:
        for run in (one, other):
            require_step(run, until)
    sections = compare(one, other, sections=only or SECTIONS, until=until)
    return report_differences("diff", sections, str(one.folder), str(other.folder), step=until)


def _find(reference: str, runs: Path) -> tuple[Run, int | None]:
    """Return the run that a reference names, and the step of its checkpoint if it names one (`RUN@step:N`)."""
    from rlcli.runs.run_ref import find_checkpoint, find_run, is_checkpoint_ref

    if is_checkpoint_ref(reference):
        run, folder, _ = find_checkpoint(reference, runs)
        if not folder.resolve().name.isdecimal():
            raise CheckpointError(f"the checkpoint {folder} is not in the folder of a run; give RUN or RUN@step:N")
        return run, int(folder.resolve().name)
    try:
        run, why = find_run(reference, runs)
    except CheckpointError as error:
        if near := did_you_mean(reference, [entry.name for entry in catalog(TASKS)[0]]):
            raise CheckpointError(f"no run and no task '{reference}'", hint=near) from error
        raise
    if reference == "latest":
        console.info(f"{run.folder} ({why})")
    return run, None

"""Options that several commands share, so that a flag means the same everywhere."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from rlcli.cli.ui.completion import agents, checkpoints, runs, tasks, words
from rlcli.cli.ui.console import console
from rlcli.errors import MachineError, UsageError

CHOOSE = "auto"
"""Stands for a value that an option may leave out (`--video`)."""

TaskName = Annotated[
    str,
    typer.Argument(autocompletion=tasks, help="A task's name, distribution:name, or a folder with a task.yaml."),
]
TaskOfPolicy = Annotated[
    str | None,
    typer.Argument(
        autocompletion=tasks,
        help="A task: its newest run is taken, else the policy it ships. Not needed with --checkpoint.",
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Argument(metavar="[KEY.PATH=VALUE]...", help="Overrides; agent.x=... addresses the chosen agent."),
]
RunRef = Annotated[str, typer.Argument(autocompletion=runs, metavar="RUN", help="A run's folder or name, or latest.")]


def _set_quiet(given: bool) -> bool:
    if given:
        console.quiet, console.verbose = True, False
    return given


def _set_verbose(given: bool) -> bool:
    if given:
        console.quiet, console.verbose = False, True
    return given


ConfigFile = Annotated[
    Path | None,
    typer.Option("--config", help="YAML merged over the task; `agent:` in it addresses the chosen agent."),
]
Agent = Annotated[str | None, typer.Option("--agent", autocompletion=agents, help="Which of the task's agents.")]
NumEnvs = Annotated[int | None, typer.Option("--num-envs", help="Short for scene.num_envs=N.")]
MAX_SEED = 2**62
Seed = Annotated[
    int,
    typer.Option("--seed", min=-1, max=MAX_SEED, help="Seed of everything random; -1 draws one and records it."),
]
Device = Annotated[
    str, typer.Option("--device", autocompletion=words("auto", "cpu", "cuda"), help="auto, cpu, cuda or cuda:N.")
]
RunName = Annotated[str | None, typer.Option("--name", help="Part of the run folder's name.")]
MaxIterations = Annotated[int | None, typer.Option("--max-iterations", help="Iterations of each training.")]
MaxSteps = Annotated[int | None, typer.Option("--max-steps", help="Environment steps of each training.")]
TaskFolder = Annotated[
    str | None,
    typer.Option("--task", help="Where the code of a task that is not installed lies now: its folder."),
]
RunsDir = Annotated[Path | None, typer.Option("--runs-dir", help="Runs folder; else RLCLI_RUNS_DIR, settings, runs/.")]
Record = Annotated[
    Path | None, typer.Option("--record", help="Write the episodes, states and actions, to FILE; `replay` steps them.")
]
RecordMode = Annotated[
    str,
    typer.Option(
        "--record-mode",
        autocompletion=words("all", "succeeded", "failed", "separate"),
        help="Which episodes: all, succeeded, failed, or separate (a file each).",
    ),
]
CheckpointRef = Annotated[
    str | None,
    typer.Option(
        "--checkpoint",
        autocompletion=checkpoints,
        help="RUN, RUN@best, RUN@step:N, a checkpoint folder, a bundle, latest, or shipped (the task's own policy).",
    ),
]
Policy = Annotated[
    str,
    typer.Option(
        "--policy", autocompletion=words("trained", "zero", "random", "lqr"), help="trained, zero, random or lqr."
    ),
]
Stochastic = Annotated[bool, typer.Option("--stochastic", help="Sample actions as in training.")]
ProbeTimeout = Annotated[
    float, typer.Option("--probe-timeout", help="Seconds that each task, trainer or driver may take.")
]
Headless = Annotated[bool, typer.Option("--headless", hidden=True, help="Accepted; nothing opens a window unasked.")]

_COMMON: dict[str, Any] = {
    "json": typer.Option("--json", help="One JSON document on stdout."),
    "quiet": typer.Option("--quiet", "-q", callback=_set_quiet, help="Errors and results only."),
    "verbose": typer.Option("--verbose", "-v", callback=_set_verbose, help="Say more; of -q and -v the last holds."),
    "debug": typer.Option("--debug", help="Tracebacks of errors."),
}
"""Options that every command has; the console holds their values."""


def with_common_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add --json, --quiet, --verbose and --debug to a command, which does not receive them."""
    signature = inspect.signature(command, eval_str=True)
    common = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=False, annotation=Annotated[bool, option])
        for name, option in _COMMON.items()
    ]

    @functools.wraps(command)
    def run(**values: Any) -> None:
        command(**{name: value for name, value in values.items() if name not in _COMMON})

    parameters = [*signature.parameters.values(), *common]
    run.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def budget(max_iterations: int | None, max_steps: int | None) -> dict[str, Any]:
    """Return the budget of the command line, which replaces the agent's whole budget; empty: the agent's own."""
    if max_iterations is None and max_steps is None:
        return {}
    return {"agent.max_iterations": max_iterations, "agent.max_steps": max_steps}


def draw_seed(seed: int) -> int:
    """Return the seed; -1 draws one."""
    if seed != -1:
        return seed
    import secrets

    return secrets.randbelow(2**31)


def video_file(video: Path | None, default: str) -> Path | None:
    """Return the file of --video, the default one if the option has no value; check that it can be written."""
    if video is None:
        return None
    from rlcli.viewer.video_writer import check_video

    file = Path(default) if str(video) == CHOOSE else video
    check_video(file)
    return file


def check_output(output: Path | None, what: str, suffixes: Sequence[str]) -> None:
    """Refuse a file that cannot be written before anything is done for it.

    Raises:
        UsageError: for a folder, or a suffix that is not one of `suffixes`.
        MachineError: if its folder is not there.
    """
    if output is None:
        return
    if output.suffix not in suffixes:
        raise UsageError(f"'{output}' is not a {what}", hint=f"name it *{', *'.join(suffixes)}")
    if output.is_dir():
        raise UsageError(f"-o {output} is a folder", hint="give a file")
    if not output.absolute().parent.is_dir():
        raise MachineError(f"cannot write {output}: there is no folder {output.absolute().parent}")


def exit_on_failures(failures: list[str]) -> None:
    """Print which limits failed, and end with exit code 9 if one did."""
    for failure in failures:
        console.info(f"failed: {failure}")
    if failures:
        raise typer.Exit(9)

"""Command `rlcli import`: conversion of a task or a trained policy of another framework.

The policies of Stable-Baselines3 and RSL-RL are built in; plugins add the conversion of task files.
"""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.ui.completion import tasks
from rlcli.cli.ui.console import console
from rlcli.cli.ui.help_text import HelpGroup
from rlcli.cli.ui.options import Agent, RunName, RunsDir, add_command, choice
from rlcli.errors import TaskError, UsageError, require_known
from rlcli.registry.formats import known_formats, load_format, missing_formats, usable_formats

if TYPE_CHECKING:
    from rlcli.config.load import Resolved
    from rlcli.formats import Imported
    from rlcli.training.import_policy import ImportedPolicy

_log = logging.getLogger(__name__)

app = typer.Typer(
    cls=HelpGroup,
    no_args_is_help=True,
    help="Import a task or a policy from another framework.",
    epilog="""\
rlcli import sb3 model.zip --task cartpole
    Import a policy of Stable-Baselines3 as a run.
rlcli import rsl-rl model_1000.pt --task quadruped-flat
    Import a policy of RSL-RL as a run.""",
)

Task = Annotated[str, typer.Option("--task", autocompletion=tasks, metavar="TASK", help="Task of the policy.")]
_ACTIVATION = "Activation of the hidden layers: elu, relu, tanh or silu. [default: the library's]"
Activation = Annotated[str | None, choice("NAME", "elu", "relu", "tanh", "silu", help=_ACTIVATION)]
Bound = Annotated[float | None, typer.Option(help="Largest absolute action. [default: 1 (sb3), none (rsl-rl)]")]


def sb3(
    file: Annotated[Path, typer.Argument(metavar="FILE.zip")],
    task: Task,
    agent: Agent = None,
    activation: Activation = None,
    action_bound: Bound = None,
    normalizer: Annotated[Path | None, typer.Option(metavar="FILE.safetensors")] = None,
    runs_dir: RunsDir = None,
    name: RunName = None,
) -> None:
    """Import a policy of Stable-Baselines3 (PPO, A2C, SAC, TD3, DDPG) as a run. Only plain data is unpickled.

    Options:
        file: File written by model.save of Stable-Baselines3.
        normalizer: Safetensors file with `mean` and `var` of `VecNormalize`, the observation normalisation.

    Examples:
        rlcli import sb3 model.zip --task cartpole
            Import a policy for cartpole.
        rlcli import sb3 model.zip --task cartpole --normalizer stats.safetensors
            Import a policy with normalised observations.
    """
    resolved = _resolve(task, agent, activation, action_bound)
    from rlcli.training.import_policy import read_sb3

    bound = 1.0 if action_bound is None else action_bound
    policy = read_sb3(file, activation=activation, action_bound=bound, normalizer=normalizer)
    _create_run("sb3", file, policy, resolved, runs_dir, name)


def rsl_rl(
    file: Annotated[Path, typer.Argument(metavar="FILE.pt")],
    task: Task,
    agent: Agent = None,
    activation: Activation = None,
    action_bound: Bound = None,
    runs_dir: RunsDir = None,
    name: RunName = None,
) -> None:
    """Import a policy of RSL-RL as a run. Only plain data is unpickled.

    Options:
        file: Checkpoint model_N.pt of RSL-RL.

    Examples:
        rlcli import rsl-rl model_1000.pt --task quadruped-flat
            Import a policy for quadruped-flat.
        rlcli import rsl-rl model_1000.pt --task quadruped-flat --activation tanh
            Import a policy with tanh layers.
    """
    resolved = _resolve(task, agent, activation, action_bound)
    from rlcli.training.import_policy import read_rsl_rl

    policy = read_rsl_rl(file, activation=activation, action_bound=action_bound)
    _create_run("rsl-rl", file, policy, resolved, runs_dir, name)


def _resolve(task: str, agent: str | None, activation: str | None, action_bound: float | None) -> Resolved:
    """Check --activation and --action-bound, and return the configuration of the task with its agent on the CPU."""
    from rlcli.config.load import resolve
    from rlcli.registry import find_task

    if activation is not None:
        require_known(activation, ("elu", "relu", "tanh", "silu"), "activation", "activations")
    if action_bound is not None and not 0.0 < action_bound < float("inf"):
        raise UsageError(f"--action-bound must be a finite number above 0, found {action_bound}")
    resolved = resolve(find_task(task), agent=agent, device="cpu")
    resolved.require_agent()
    return resolved


def _create_run(
    form: str, file: Path, policy: ImportedPolicy, resolved: Resolved, runs_dir: Path | None, name: str | None
) -> None:
    """Write an imported policy as a new run, and print what was imported."""
    from rlcli.registry.task_location import task_reference
    from rlcli.runs.run_ref import default_runs_dir
    from rlcli.training.import_policy import create_imported_run

    record = {"imported": {"form": form, "file": file.name, "algorithm": policy.algorithm}}
    run = create_imported_run(policy, resolved, record, runs_dir or default_runs_dir(), name)
    spec = policy.spec
    hidden = " x ".join(map(str, spec["hidden"])) or "none"
    bound = "unbounded" if spec["action_bound"] is None else f"within +-{spec['action_bound']:g}"
    console.info(
        f"{form} {policy.algorithm}: {spec['observation_size']} observations, hidden layers {hidden}"
        f" ({spec['activation']}), {spec['action_size']} actions {bound}"
    )
    task = task_reference(resolved.source.record())
    console.info(f"next: `rlcli play --checkpoint {run}` or `rlcli train {task} --init-from {run}`")
    console.data(str(run))
    console.document("import", form=form, run=str(run), algorithm=policy.algorithm, policy=spec)


def _importer(form: str, convert: Callable[..., Imported]) -> Callable[..., None]:
    """Return the command `rlcli import NAME` for a task format; its options and help are those of `convert`."""

    @functools.wraps(convert)
    def command(**values: Any) -> None:
        _report(form, convert(**values))

    return command


def _report(form: str, imported: Imported) -> None:
    """Print how each key of an imported task was translated, and the files that were written."""
    rows = [
        [note.key, "read by the class" if note.status == "task" else note.status, note.where, note.text]
        for note in imported.notes
    ]
    console.table(["KEY", "STATUS", "WHERE", "NOTE"], rows)
    for text in [*(str(note) for note in imported.notes if note.status == "to do"), *imported.messages]:
        console.info(text)
    console.info(f"wrote {', '.join(str(file) for file in imported.files)}; next: rlcli train {imported.folder}")
    console.document(
        "import",
        form=form,
        folder=str(imported.folder),
        files=[str(file) for file in imported.files],
        keys=[{"key": n.key, "status": n.status, "where": n.where, "note": n.text} for n in imported.notes],
    )


def _add_formats() -> None:
    """Add the commands `rlcli import NAME`: policies, and task formats of installed plugins.

    For a known format without its plugin, a hidden command prints how to install the plugin.
    """
    add_command(app, "sb3", sb3)
    add_command(app, "rsl-rl", rsl_rl)
    added = set()
    for form in usable_formats():
        if form.spec.importer:
            try:
                convert = form.load(form.spec.importer)
            except TaskError as error:  # one broken plugin must not disable the other commands
                _log.warning(error)
                continue
            added.add(form.name)
            add_command(app, form.name, _importer(form.name, convert))
    any_arguments = {"ignore_unknown_options": True, "allow_extra_args": True}
    for name in sorted(known_formats().keys() - added):
        app.command(name, hidden=True, context_settings=any_arguments)(_missing(name))


def _missing(name: str) -> Callable[[], None]:
    """Return a command for a task format whose plugin is missing or broken; its error says what to install."""

    def command() -> None:
        missing = missing_formats()
        if name in missing:
            raise missing[name].missing()
        form = load_format(name)
        form.load(form.spec.importer)

    return command


_add_formats()

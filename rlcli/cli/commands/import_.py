"""`rlcli import FORM FILE...`: a task or a policy of another tool in rlcli's own form."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import Agent, RunName, RunsDir, with_common_options
from rlcli.errors import TaskError, UsageError, require_known
from rlcli.registry.formats import known_formats, load_format, missing_formats, usable_formats

if TYPE_CHECKING:
    from rlcli.config.load import Resolved
    from rlcli.formats import Imported
    from rlcli.training.import_checkpoint import ImportedPolicy

_log = logging.getLogger(__name__)

app = typer.Typer(no_args_is_help=True, help="Bring a task or a policy of another tool over.")


def _importer(form: str, convert: Callable[..., Imported]) -> Callable[..., None]:
    """Return a command with the parameters of an importer."""

    @functools.wraps(convert)
    def command(**values: Any) -> None:
        _report(form, convert(**values))

    return command


TaskOption = Annotated[str, typer.Option("--task", help="The task that it is a policy for.")]
Activation = Annotated[
    str | None,
    typer.Option("--activation", help="elu, relu, tanh or silu: of the hidden layers; weights do not tell."),
]
Bound = Annotated[float | None, typer.Option("--action-bound", help="Its actions lay within +-this.")]


@app.command("sb3")
@with_common_options
def sb3(
    file: Annotated[Path, typer.Argument(metavar="FILE.zip", help="What model.save of Stable-Baselines3 wrote.")],
    task: TaskOption,
    agent: Agent = None,
    activation: Activation = None,
    action_bound: Bound = None,
    normalizer: Annotated[
        Path | None, typer.Option(metavar="FILE.safetensors", help="mean and var of its VecNormalize.")
    ] = None,
    runs_dir: RunsDir = None,
    name: RunName = None,
) -> None:
    """Import a policy of Stable-Baselines3 as a run. PPO, A2C, SAC, TD3 or DDPG; nothing is unpickled."""
    _check_policy(activation, action_bound)
    resolved = _resolved(task, agent)
    from rlcli.training.import_checkpoint import read_sb3

    bound = 1.0 if action_bound is None else action_bound
    foreign = read_sb3(file, activation=activation, action_bound=bound, normalizer=normalizer)
    _as_run("sb3", file, foreign, resolved, runs_dir, name)


@app.command("rsl-rl")
@with_common_options
def rsl_rl(
    file: Annotated[Path, typer.Argument(metavar="FILE.pt", help="model_N.pt of RSL-RL.")],
    task: TaskOption,
    agent: Agent = None,
    activation: Activation = None,
    action_bound: Bound = None,
    runs_dir: RunsDir = None,
    name: RunName = None,
) -> None:
    """Import a policy of RSL-RL as a run. Nothing is unpickled."""
    _check_policy(activation, action_bound)
    resolved = _resolved(task, agent)
    from rlcli.training.import_checkpoint import read_rsl_rl

    foreign = read_rsl_rl(file, activation=activation, action_bound=action_bound)
    _as_run("rsl-rl", file, foreign, resolved, runs_dir, name)


def _check_policy(activation: str | None, action_bound: float | None) -> None:
    if activation is not None:
        require_known(activation, ("elu", "relu", "tanh", "silu"), "activation", "activations")
    if action_bound is not None and not 0.0 < action_bound < float("inf"):
        raise UsageError(f"--action-bound {action_bound} is no bound", hint="a number above 0")


def _resolved(task: str, agent: str | None) -> Resolved:
    from rlcli.config.load import resolve
    from rlcli.registry import find_task

    resolved = resolve(find_task(task), agent=agent, device="cpu")
    resolved.require_agent()
    return resolved


def _as_run(
    form: str, file: Path, foreign: ImportedPolicy, resolved: Resolved, runs_dir: Path | None, name: str | None
) -> None:
    from rlcli.runs.run_ref import default_runs_dir
    from rlcli.training.import_checkpoint import create_imported_run

    record = {"imported": {"form": form, "file": file.name, "algorithm": foreign.algorithm}}
    run = create_imported_run(foreign, resolved, record, runs_dir or default_runs_dir(), name)
    spec = foreign.spec
    hidden = " x ".join(map(str, spec["hidden"])) or "none"
    bound = "unbounded" if spec["action_bound"] is None else f"within +-{spec['action_bound']:g}"
    console.info(
        f"{form} {foreign.algorithm}: {spec['observation_size']} observations, hidden layers {hidden}"
        f" ({spec['activation']}), {spec['action_size']} actions {bound}"
    )
    console.info(f"next: rlcli play --checkpoint {run}, or rlcli train {resolved.source.name} --init-from {run}")
    console.data(str(run))
    console.document("import", form=form, run=str(run), algorithm=foreign.algorithm, policy=spec)


def _report(form: str, imported: Imported) -> None:
    console.table(
        ["KEY", "BECAME", "WHERE", "NOTE"],
        [
            [note.key, "the class's" if note.status == "task" else note.status, note.where, note.text]
            for note in imported.notes
        ],
    )
    for note in imported.notes:
        if note.status == "to do":
            console.info(str(note))
    for text in imported.messages:
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
    """Add a command for each installed format that can import, and one that names the plugin of each other one."""
    added = set()
    for form in usable_formats():
        if form.spec.importer:
            try:
                convert = form.load(form.spec.importer)
            except TaskError as error:  # the other commands stay
                _log.warning(error)
                continue
            added.add(form.name)
            app.command(form.name)(with_common_options(_importer(form.name, convert)))
    anything = {"ignore_unknown_options": True, "allow_extra_args": True}
    for name in sorted(known_formats().keys() - added):
        app.command(name, hidden=True, context_settings=anything)(_unusable(name))


def _unusable(name: str) -> Callable[[], None]:
    """Return a command that names the plugin of a format, or says why it is broken."""

    def command() -> None:
        missing = missing_formats()
        if name in missing:
            raise missing[name].missing()
        form = load_format(name)
        form.load(form.spec.importer)

    return command


_add_formats()

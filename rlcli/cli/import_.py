"""`rlcli import FORM FILE...`: a task or a policy of another tool in rlcli's own form."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.console import console
from rlcli.cli.options import Agent, Debug, Json, Quiet, RunsDir, Verbose

if TYPE_CHECKING:
    from rlcli.config.imported import Imported
    from rlcli.config.load import Resolved

app = typer.Typer(no_args_is_help=True, help="Bring a task or a policy of another tool over.")

Output = Annotated[
    Path | None, typer.Option("--output", "-o", help="Folder to write; a new one named after the task if left out.")
]


@app.command("oige")
def oige(
    task: Annotated[Path, typer.Argument(metavar="TASK.yaml", help="cfg/task/NAME.yaml of OmniIsaacGymEnvs.")],
    train: Annotated[
        Path | None, typer.Argument(metavar="[TRAINPPO.yaml]", help="Its cfg/train/NAMEPPO.yaml, of rl_games.")
    ] = None,
    output: Output = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Import a task's YAML of OmniIsaacGymEnvs. Its class goes on as it is."""
    from rlcli.config.oige_import import convert

    _tell("oige", convert([task] if train is None else [task, train], output))


@app.command("isaaclab")
def isaaclab(
    env: Annotated[Path, typer.Argument(metavar="ENV.yaml", help="params/env.yaml of a run.")],
    agent: Annotated[Path | None, typer.Argument(metavar="[AGENT.yaml]", help="params/agent.yaml of RSL-RL.")] = None,
    output: Output = None,
    model: Annotated[
        list[str] | None, typer.Option("--model", help="ENTITY=FILE.xml: the MJCF of a robot or object; repeatable.")
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Import the settings of an Isaac Lab run. These are its env.yaml and agent.yaml."""
    from rlcli.errors import UsageError
    from rlcli.isaaclab.importer import convert

    models = dict(given.partition("=")[::2] for given in model or [])
    for name, file in models.items():
        if not file or not Path(file).is_file():
            raise UsageError(f"--model {name}={file}: there is no such file", hint="--model robot=robot.xml")
    _tell("isaaclab", convert(env, agent, output or Path("imported"), models))


TaskOption = Annotated[str, typer.Option("--task", help="The task that it is a policy for.")]
Activation = Annotated[
    str | None,
    typer.Option("--activation", help="elu, relu, tanh or silu: of the hidden layers; weights do not tell."),
]
Bound = Annotated[float | None, typer.Option("--action-bound", help="Its actions lay within +-this.")]
RunName = Annotated[str | None, typer.Option("--name", help="Part of the run folder's name.")]


@app.command("sb3")
def sb3(
    file: Annotated[Path, typer.Argument(metavar="FILE.zip", help="What model.save of Stable-Baselines3 wrote.")],
    task: TaskOption,
    agent: Agent = None,
    activation: Activation = None,
    action_bound: Bound = None,
    normalizer: Annotated[
        Path | None,
        typer.Option("--normalizer", metavar="FILE.safetensors", help="mean and var of its VecNormalize."),
    ] = None,
    runs_dir: RunsDir = None,
    name: RunName = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Import a policy of Stable-Baselines3 as a run. PPO, A2C, SAC, TD3 or DDPG; nothing is unpickled."""
    _check_policy(activation, action_bound)
    resolved = _resolved(task, agent)
    from rlcli.rl.foreign import read_sb3

    bound = 1.0 if action_bound is None else action_bound
    foreign = read_sb3(file, activation=activation, action_bound=bound, normalizer=normalizer)
    _as_run("sb3", file, foreign, resolved, runs_dir, name)


@app.command("rsl-rl")
def rsl_rl(
    file: Annotated[Path, typer.Argument(metavar="FILE.pt", help="model_N.pt of RSL-RL.")],
    task: TaskOption,
    agent: Agent = None,
    activation: Activation = None,
    action_bound: Bound = None,
    runs_dir: RunsDir = None,
    name: RunName = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Import a policy of RSL-RL as a run. Nothing is unpickled."""
    _check_policy(activation, action_bound)
    resolved = _resolved(task, agent)
    from rlcli.rl.foreign import read_rsl_rl

    foreign = read_rsl_rl(file, activation=activation, action_bound=action_bound)
    _as_run("rsl-rl", file, foreign, resolved, runs_dir, name)


def _check_policy(activation: str | None, action_bound: float | None) -> None:
    from rlcli.errors import UsageError, did_you_mean

    known = ("elu", "relu", "tanh", "silu")
    if activation is not None and activation not in known:
        hint = did_you_mean(activation, known) or f"activations: {', '.join(known)}"
        raise UsageError(f"no activation '{activation}'", hint=hint)
    if action_bound is not None and not 0.0 < action_bound < float("inf"):
        raise UsageError(f"--action-bound {action_bound} is no bound", hint="a number above 0")


def _resolved(task: str, agent: str | None) -> Resolved:
    from rlcli.config.load import resolve
    from rlcli.registry import find_task

    resolved = resolve(find_task(task), agent=agent, device="cpu")
    resolved.require_agent()
    return resolved


def _as_run(form: str, file: Path, foreign: Any, resolved: Resolved, runs_dir: Path | None, name: str | None) -> None:
    from rlcli.rl.foreign import as_run
    from rlcli.rl.run import default_runs_dir

    record = {"imported": {"form": form, "file": file.name, "algorithm": foreign.algorithm}}
    run = as_run(foreign, resolved, record, runs_dir or default_runs_dir(), name)
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


def _tell(form: str, imported: Imported) -> None:
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

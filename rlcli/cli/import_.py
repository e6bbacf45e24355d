"""`rlcli import FORM FILE...`: a task of another tool as files of rlcli's own, each key of the source accounted for."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.console import console
from rlcli.cli.options import Debug, Json

if TYPE_CHECKING:
    from rlcli.config.imported import Imported

app = typer.Typer(no_args_is_help=True, help="Bring a task of another tool over.")

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
    debug: Debug = False,
) -> None:
    """Import a task's YAML of OmniIsaacGymEnvs; its class goes on as it is."""
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
    debug: Debug = False,
) -> None:
    """Import the env.yaml and agent.yaml that Isaac Lab writes into a run."""
    from rlcli.errors import UsageError
    from rlcli.isaaclab.importer import convert

    models = dict(given.partition("=")[::2] for given in model or [])
    for name, file in models.items():
        if not file or not Path(file).is_file():
            raise UsageError(f"--model {name}={file}: there is no such file", hint="--model robot=robot.xml")
    _tell("isaaclab", convert(env, agent, output or Path("imported"), models))


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

"""The command `rlcli import isaaclab`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlcli.formats import Imported


def import_run(
    env: Annotated[Path, typer.Argument(metavar="ENV.yaml", help="params/env.yaml of a run.")],
    agent: Annotated[Path | None, typer.Argument(metavar="AGENT.yaml", help="params/agent.yaml of RSL-RL.")] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="FOLDER", help="Folder to write. [default: imported]"),
    ] = None,
    model: Annotated[
        list[str] | None,
        typer.Option("--model", metavar="ENTITY=FILE", help="MJCF model of a robot or object; repeatable."),
    ] = None,
) -> Imported:
    """Import the task and the agent of an Isaac Lab run, from its files env.yaml and agent.yaml.

    Examples:
        rlcli import isaaclab env.yaml agent.yaml --model robot=robot.xml
            Import a task and its agent, with the MJCF model of the robot.
        rlcli import isaaclab env.yaml -o my_task --model robot=robot.xml
            Import only the task, into another folder.
    """
    from rlcli.errors import UsageError
    from rlcli_isaaclab.importer import convert

    models = dict(item.partition("=")[::2] for item in model or [])
    for name, file in models.items():
        if not file or not Path(file).is_file():
            raise UsageError(
                f"--model {name}={file}: there is no file '{file}'",
                hint="correct the path, as in --model robot=robot.xml",
            )
    return convert(env, agent, output or Path("imported"), models)

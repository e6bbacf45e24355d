"""The command `rlcli import oige`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlcli.formats import Imported


def import_task(
    task: Annotated[Path, typer.Argument(metavar="TASK.yaml", help="cfg/task/NAME.yaml of OmniIsaacGymEnvs.")],
    train: Annotated[
        Path | None, typer.Argument(metavar="TRAINPPO.yaml", help="cfg/train/NAMEPPO.yaml of the task, for rl_games.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="FOLDER", help="Folder to write. [default: a new folder named after the task]"
        ),
    ] = None,
) -> Imported:
    """Import a task's YAML of OmniIsaacGymEnvs. Its class stays unchanged except for import lines.

    Examples:
        rlcli import oige Cartpole.yaml
            Import a task into a new folder named after it.
        rlcli import oige Cartpole.yaml CartpolePPO.yaml -o my_cartpole
            Import a task and its agent into another folder.
    """
    from rlcli_oige.importer import convert

    return convert([task] if train is None else [task, train], output)

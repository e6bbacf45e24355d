"""The command `rlcli import oige`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlcli.formats import Imported


def import_task(
    task: Annotated[Path, typer.Argument(metavar="TASK.yaml", help="cfg/task/NAME.yaml of OmniIsaacGymEnvs.")],
    train: Annotated[
        Path | None, typer.Argument(metavar="[TRAINPPO.yaml]", help="Its cfg/train/NAMEPPO.yaml, of rl_games.")
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder to write. [default: the task's name]"),
    ] = None,
) -> Imported:
    """Import a task's YAML of OmniIsaacGymEnvs. Its class stays unchanged except for import lines."""
    from rlcli_oige.importer import convert

    return convert([task] if train is None else [task, train], output)

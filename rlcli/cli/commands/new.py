"""`rlcli new`: an installable package with a new task."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import choice


def command(
    name: Annotated[str, typer.Argument()],
    flavour: Annotated[str, choice("FLAVOUR", "yaml", "direct")] = "yaml",
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="FOLDER")] = None,
) -> None:
    """Write the package of a new task with model, configuration, code and tests.

    Options:
        name: Name of the task in lowercase letters, digits and hyphens, such as my-arm.
        flavour: yaml (lists of terms), or direct (one class with the hooks of the direct workflow).
        output: Folder to write. [default: a new folder named after the task]

    Examples:
        rlcli new my-arm
            Write a package with a YAML task into the folder my-arm.
        rlcli new my-arm --flavour direct -o packages/my-arm
            Write a package with a task class into another folder.
    """
    from rlcli.scaffold import create

    folder, files = create(name, flavour, output)
    for file in files:
        console.data(str(folder / file))
    console.info(f"next: cd {folder} && pip install -e . && rlcli train {name}")
    console.document("new", task=name, flavour=flavour, folder=str(folder), files=files)

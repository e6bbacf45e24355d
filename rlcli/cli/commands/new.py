"""`rlcli new NAME`: a task of one's own as a package that can be installed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlcli.cli.ui.console import console


def command(
    name: Annotated[str, typer.Argument(help="The task's name, small letters and hyphens: my-arm.")],
    flavour: Annotated[
        str, typer.Option(help="yaml: lists of terms; direct: one class with the hooks of the direct workflow.")
    ] = "yaml",
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder to write; a new one named after the task if left out.")
    ] = None,
) -> None:
    """Write the package of a new task. It has: model, configuration, code, tests."""
    from rlcli.scaffold import create

    folder, files = create(name, flavour, output)
    for file in files:
        console.data(str(folder / file))
    console.info(f"next: cd {folder} && pip install -e . && rlcli train {name}")
    console.document("new", task=name, flavour=flavour, folder=str(folder), files=files)

"""`rlcli import FORM FILE...`: a task of another tool as files of rlcli's own, each key of the source accounted for."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Annotated

import typer

from rlcli.cli.console import console
from rlcli.cli.options import Debug, Json

FORMS = {
    "oige": "rlcli.config.oige_import:convert",
}
"""Form -> function (files, output folder) -> `rlcli.config.imported.Imported`."""


def command(
    form: Annotated[str, typer.Argument(metavar="FORM", help=f"Whose files: {', '.join(FORMS)}.")],
    files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="oige: TASK.yaml [TRAINPPO.yaml].")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder to write; a new one named after the task if left out.")
    ] = None,
    json: Json = False,
    debug: Debug = False,
) -> None:
    """Bring a task of another tool over."""
    from rlcli.errors import UsageError, did_you_mean, listing

    if form not in FORMS:
        raise UsageError(f"no form '{form}'", hint=did_you_mean(form, FORMS) or f"forms: {listing(FORMS)}")
    module, _, name = FORMS[form].partition(":")
    imported = getattr(importlib.import_module(module), name)(files, output)
    console.table(
        ["KEY", "BECAME", "WHERE", "NOTE"],
        [
            [note.key, "the class's" if note.status == "task" else note.status, note.where, note.text]
            for note in imported.notes
        ],
    )
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

"""`rlcli import KIND FILES`: tasks of other frameworks as tasks of rlcli's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlcli.cli.console import console
from rlcli.cli.options import Debug, Json

app = typer.Typer(no_args_is_help=True, help="Turn another framework's configuration into a task of rlcli's.")


@app.command("isaaclab")
def isaaclab(
    env: Annotated[Path, typer.Argument(metavar="ENV.yaml", help="params/env.yaml of a run.")],
    agent: Annotated[Path | None, typer.Argument(metavar="[AGENT.yaml]", help="params/agent.yaml of RSL-RL.")] = None,
    output: Annotated[Path, typer.Option("--output", "-o", help="The task's folder.")] = Path("imported"),
    model: Annotated[
        list[str] | None, typer.Option("--model", help="ENTITY=FILE.xml: the MJCF of a robot or object; repeatable.")
    ] = None,
    json: Json = False,
    debug: Debug = False,
) -> None:
    """Import the env.yaml and agent.yaml that Isaac Lab writes into a run."""
    from rlcli.errors import UsageError
    from rlcli.isaaclab.importer import run

    models = dict(given.partition("=")[::2] for given in model or [])
    for name, file in models.items():
        if not file or not Path(file).is_file():
            raise UsageError(f"--model {name}={file}: there is no such file", hint="--model robot=robot.xml")
    done = run(env, agent, output, models)
    rows = done.rows()
    for key, status, why in rows:
        if status not in ("mapped", "default"):
            console.info(f"{status}: {key}{f' ({why})' if why else ''}")
    counts = {status: sum(row[1] == status for row in rows) for status in dict.fromkeys(row[1] for row in rows)}
    console.data(f"{output / 'task.yaml'}: {', '.join(f'{count} {status}' for status, count in counts.items())}")
    console.document(
        "import",
        folder=str(output),
        files=done.files,
        keys=[{"key": key, "status": status, "why": why} for key, status, why in rows],
    )

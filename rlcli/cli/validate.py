"""`rlcli validate FILE|TASK`: every mistake of the files at once; `--deep` the compiled model too."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rlcli.cli.console import console
from rlcli.cli.options import Agent, ConfigFile, Debug, Json, Overrides


def command(
    target: Annotated[str, typer.Argument(metavar="FILE|TASK", help="A task.yaml, its folder, or a task's name.")],
    overrides: Overrides = None,
    deep: Annotated[bool, typer.Option("--deep", help="Also compile the model and resolve every name in it.")] = False,
    agent: Agent = None,
    config: ConfigFile = None,
    json: Json = False,
    debug: Debug = False,
) -> None:
    """Check a task's configuration."""
    from rlcli.config.load import resolve

    source = _source(target)
    resolved = resolve(source, agent=agent, config_file=config, overrides=overrides or ())
    # the play: patch must hold as well
    resolve(source, agent=agent, play=True, config_file=config, overrides=overrides or ())
    checked = "files"
    if deep:
        from rlcli.envs.vec_env import make_env

        small = resolve(source, agent=agent, config_file=config, overrides=overrides or (), flags={"scene.num_envs": 2})
        make_env(small).reset(seed=0)
        checked = "files and model"
    console.data(f"{source.label}: valid ({checked})")
    console.document("validate", file=str(source.config), valid=True, deep=deep, agent=resolved.agent_name)


def _source(target: str):
    from dataclasses import replace

    from rlcli.errors import TaskError
    from rlcli.registry import catalog, find_task, folder_task, load_entry, packaged_task
    from rlcli.task import TaskSpec

    file = Path(target)
    if file.suffix not in (".yaml", ".yml"):
        return find_task(target)
    if not file.is_file():
        raise TaskError(f"no file '{target}'")
    # a YAML of an installed task keeps that task's terms and class
    for entry in catalog()[0]:
        try:
            source = packaged_task(entry, load_entry(entry, TaskSpec))
        except TaskError:
            continue
        if source.config.resolve() == file.resolve():
            return source
    return replace(folder_task(file.parent, file.name), name=file.stem)

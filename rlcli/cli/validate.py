"""`rlcli validate FILE|TASK`: every mistake of the files at once; `--deep` the compiled model too."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from rlcli.cli.completion import tasks
from rlcli.cli.console import console
from rlcli.cli.options import Agent, ConfigFile, Debug, Json, Overrides, Quiet, Verbose, tell_notes
from rlcli.errors import TaskError
from rlcli.registry import TaskSource, find_task, folder_task, task_of_file


def command(
    target: Annotated[
        str,
        typer.Argument(autocompletion=tasks, metavar="FILE|TASK", help="A task.yaml, its folder, or a task's name."),
    ],
    overrides: Overrides = None,
    deep: Annotated[bool, typer.Option("--deep", help="Also compile the model and resolve every name in it.")] = False,
    agent: Agent = None,
    config: ConfigFile = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Check a task's configuration."""
    from rlcli.config.load import check_all, resolve

    source = task_source(target)
    given = overrides or []
    unchecked = [] if agent else check_all(source, config_file=config, overrides=given)
    resolved = resolve(source, agent=agent, config_file=config, overrides=given)
    resolve(source, agent=agent, play=True, config_file=config, overrides=given)
    checked = "files"
    if deep:
        from rlcli.envs.vec_env import make_env

        small = resolve(source, agent=agent, config_file=config, overrides=given, flags={"scene.num_envs": 2})
        make_env(small).reset(seed=0)
        checked = "files and model"
    tell_notes(resolved)
    console.data(f"{source.label}: valid ({checked})")
    if unchecked:
        console.warn(f"not checked, their trainer is not installed: agents {', '.join(unchecked)}")
    console.document(
        "validate",
        file=str(source.config),
        valid=True,
        deep=deep,
        agent=resolved.agent_name,
        unchecked_agents=unchecked,
        notes=[str(note) for note in resolved.notes],
    )


def task_source(target: str) -> TaskSource:
    """A task by its name, its folder, or any YAML file that describes one."""
    file = Path(target)
    if file.suffix not in (".yaml", ".yml"):
        return find_task(target)
    if not file.is_file():
        raise TaskError(f"no file '{target}'")
    # a YAML of an installed task keeps that task's terms and class
    return task_of_file(file) or replace(folder_task(file.parent, file.name), name=file.stem)

"""`rlcli validate FILE|TASK`: every mistake of the files at once; `--deep` the compiled model too."""

from __future__ import annotations

from typing import Annotated

import typer

from rlcli.cli.ui.completion import tasks
from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import Agent, ConfigFile, Overrides
from rlcli.formats import log_notes
from rlcli.registry import task_source


def command(
    target: Annotated[
        str,
        typer.Argument(autocompletion=tasks, metavar="FILE|TASK", help="A task.yaml, its folder, or a task's name."),
    ],
    overrides: Overrides = None,
    deep: Annotated[bool, typer.Option("--deep", help="Also compile the model and resolve every name in it.")] = False,
    agent: Agent = None,
    config: ConfigFile = None,
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
        from rlcli.envs.make import make_env

        small = resolve(source, agent=agent, config_file=config, overrides=given, flags={"scene.num_envs": 2})
        make_env(small).reset(seed=0)
        checked = "files and model"
    log_notes(resolved.notes)
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

"""Command `rlcli validate`: check of a task's configuration, which reports all mistakes at once.

With --deep the command also compiles the model and looks up all names of joints, bodies and sensors in it.
"""

from typing import Annotated

import typer

from rlcli.cli.ui.completion import tasks
from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import Agent, ConfigFile, Overrides
from rlcli.formats import log_notes
from rlcli.registry import task_source


def command(
    target: Annotated[str, typer.Argument(autocompletion=tasks, metavar="FILE|TASK")],
    overrides: Overrides = None,
    deep: Annotated[bool, typer.Option("--deep")] = False,
    agent: Agent = None,
    config: ConfigFile = None,
) -> None:
    """Check a task's configuration and print all mistakes at once.

    Options:
        target: A task.yaml, its folder, or the name of a task.
        deep: Also compile the model and resolve all names of joints, bodies and sensors in it.

    Examples:
        rlcli validate ./my_task --deep
            Check the files and the model of a task in a folder.
        rlcli validate cartpole rewards.alive.weight=2
            Check overrides without training.
    """
    from rlcli.config.load import check_all, missing_models, resolve

    source = task_source(target)
    words = overrides or []
    unchecked = [] if agent else check_all(source, config_file=config, overrides=words)
    resolved = resolve(source, agent=agent, config_file=config, overrides=words)
    resolve(source, agent=agent, play=True, config_file=config, overrides=words)
    if deep:
        from rlcli.envs.make import make_env

        small = resolve(source, agent=agent, config_file=config, overrides=words, flags={"scene.num_envs": 2})
        make_env(small).reset(seed=0)
    missing = missing_models(resolved)
    log_notes(resolved.notes)
    shown = target if source.python is not None and source.distribution is None else source.label
    console.data(f"{shown}: valid ({'files and model' if deep else 'files'})")
    for sentence in missing:
        console.warn(f"model of {sentence}")
    if unchecked:
        names = ", ".join(unchecked)
        console.warn(f"not checked, because the trainer is not installed: agents {names}; install the trainer")
    console.document(
        "validate",
        file=str(source.config),
        valid=True,
        deep=deep,
        agent=resolved.agent_name,
        unchecked_agents=unchecked,
        notes=[str(note) for note in resolved.notes],
    )

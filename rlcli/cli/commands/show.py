"""Command `rlcli show`: printout of a task's resolved configuration.

The command can also print the origin of each value (file and line, or option), or the JSON Schema of a task file.
"""

import json as json_module
from typing import Annotated

import typer

from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import Agent, ConfigFile, NumEnvs, Overrides, TaskName


def command(
    task: TaskName,
    overrides: Overrides = None,
    origin: Annotated[bool, typer.Option("--origin")] = False,
    schema: Annotated[bool, typer.Option("--schema")] = False,
    play: Annotated[bool, typer.Option("--play")] = False,
    agent: Agent = None,
    num_envs: NumEnvs = None,
    config: ConfigFile = None,
) -> None:
    """Print a task's resolved configuration, or only the parts whose keys (such as `rewards`) follow the task.

    Options:
        origin: Show the origin of each value: file and line, override, flag or default.
        schema: Print the JSON Schema of the task's YAML instead, for editors.
        play: Apply the task's `play:` patch, as play and eval do.

    Examples:
        rlcli show cartpole --origin
            Print all settings with their origin.
        rlcli show cartpole rewards sim.dt sim.dt=0.005 --agent ppo
            Print the rewards and one setting, with an override and another agent.
    """
    from rlcli.config.dump import json_schema, origins, select, to_data, to_yaml, to_yaml_with_origins
    from rlcli.config.layers import flags
    from rlcli.config.load import extensions, resolve
    from rlcli.registry import find_task

    source = find_task(task)
    if schema:
        content = json_schema(*extensions(source))
        console.data(*json_module.dumps(content, indent=2).split("\n"))
        console.document("show", schema_document=content)
        return
    words = overrides or []
    changes, keys = [word for word in words if "=" in word], [word for word in words if "=" not in word]
    values = flags(scene__num_envs=num_envs)
    resolved = resolve(source, agent=agent, play=play, config_file=config, overrides=changes, flags=values)
    data = select(to_data(resolved), keys)
    text = to_yaml_with_origins(resolved, data) if origin else to_yaml(data)
    console.data(*text.rstrip("\n").split("\n"))
    console.document("show", config=data, **({"origins": origins(resolved, data)} if origin else {}))

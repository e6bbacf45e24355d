"""Program that loads plugins and writes descriptions; `rlcli list-tasks` runs this program in a separate process.

`python -m rlcli.envs.describe_plugins GROUP FILE NAME...` appends a line of JSON to FILE for each named task, trainer
or format. `--index DISTRIBUTION` prints the `index.json` that a distribution ships for `list-tasks`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import replace

from rlcli import registry
from rlcli.errors import MissingModelError, RlcliError
from rlcli.registry.formats import load_format
from rlcli.registry.probe import Details
from rlcli.trainers import TrainerSpec


def describe(name: str) -> Details:
    """Load a task, build one environment of the task, and return the task's description.

    Raises:
        RlcliError: if the environment cannot be built.
    """
    from rlcli.config.load import resolve
    from rlcli.envs.make import make_env

    source = registry.find_task(name)
    task = resolve(source)
    env = make_env(resolve(source, flags={"scene.num_envs": 1}))
    return Details(
        summary=task.task.summary,
        workflow="direct" if source.task else "managed",
        observation_size=env.layout.size("policy"),
        action_size=env.layout.action_size,
        num_envs=task.task.scene.num_envs,
        agent=task.agent_name,
        policy=source.policy is not None,
    )


def try_trainer(name: str) -> Details:
    """Load a trainer's `TrainerSpec`, the models of its settings and its class; return the trainer's description.

    Raises:
        RlcliError: if one of these cannot be loaded.
    """
    entry = registry.find_entry(registry.TRAINERS, name, what="trainer")
    spec = registry.load_entry(entry, TrainerSpec)
    for reference in (*spec.algorithms.values(), spec.trainer):
        registry.load_entry(replace(entry, value=reference), object)
    return Details(summary=spec.summary)


def try_format(name: str) -> Details:
    """Load a format's `FormatSpec` and every function or class that it names; return the format's description.

    Raises:
        RlcliError: if one of these cannot be loaded.
    """
    form = load_format(name)
    spec = form.spec
    references = (spec.find, spec.read, spec.check, spec.environment, spec.importer, spec.hint, spec.agents_beside)
    for reference in filter(None, references):
        form.load(reference)
    return Details(summary=spec.summary)


_LOADERS = {registry.TASKS: describe, registry.TRAINERS: try_trainer, registry.FORMATS: try_format}


def main(arguments: list[str]) -> None:
    """Append a description of each named plugin to a file, or print the `index.json` of a distribution's plugins."""
    parser = argparse.ArgumentParser(prog="python -m rlcli.envs.describe_plugins", description=__doc__)
    parser.add_argument("--index", metavar="DISTRIBUTION", help="print the index.json of this distribution")
    parser.add_argument("group", nargs="?", choices=_LOADERS)
    parser.add_argument("file", nargs="?")
    parser.add_argument("names", nargs="*")
    options = parser.parse_args(arguments)
    if options.index:
        names = [entry.qualified for entry in registry.catalog()[0] if entry.distribution == options.index]
        index = {name.partition(":")[2]: describe(name).record() for name in names}
        sys.stdout.write(json.dumps(index, indent=1) + "\n")
        return
    if options.file is None:
        parser.error("the following arguments are required: group, file")
    with registry.malformed_metadata_ignored():
        for name in options.names:
            details = _details(name, _LOADERS[options.group])
            with open(options.file, "ab") as rows:
                rows.write(json.dumps(details.record()).encode() + b"\n")


def _details(name: str, load: Callable[[str], Details]) -> Details:
    try:
        return load(name)
    except RlcliError as error:
        first, *more = error.message.splitlines()
        reason = f"{first[:300]} (and {len(more)} more)" if more else first[:300]
        return Details(broken=reason, remedy=error.hint if isinstance(error, MissingModelError) else None)
    except BaseException as error:
        return Details(broken=f"{type(error).__name__}: {error}"[:300])


if __name__ == "__main__":
    main(sys.argv[1:])

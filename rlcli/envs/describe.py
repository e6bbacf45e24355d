"""`python -m rlcli.envs.describe TASK`: what a task is, found by building it; `rlcli.probe` reads the last line.

`--index DISTRIBUTION` prints the `index.json` that a distribution ships for `list-tasks`.
"""

from __future__ import annotations

import json
import sys

from rlcli.config.load import resolve
from rlcli.envs.vec_env import make_env
from rlcli.errors import RlcliError
from rlcli.probe import Details
from rlcli.registry import catalog, find_task


def describe(name: str) -> Details:
    """Load a task and build one environment of it.

    Raises:
        RlcliError: if it cannot be built.
    """
    source = find_task(name)
    task = resolve(source)
    env = make_env(resolve(source, flags={"scene.num_envs": 1}))
    return Details(
        summary=task.task.summary,
        workflow="direct" if source.task else "managed",
        observation_size=env.layout.size("policy"),
        action_size=env.layout.action_size,
        num_envs=task.task.scene.num_envs,
        agent=task.agent_name,
    )


def main(arguments: list[str]) -> None:
    """Print a task's details, or why it is broken, as one line of JSON; or the index of a distribution."""
    if len(arguments) == 2 and arguments[0] == "--index":
        names = [entry.qualified for entry in catalog()[0] if entry.distribution == arguments[1]]
        index = {name.partition(":")[2]: describe(name).record() for name in names}
        sys.stdout.write(json.dumps(index, indent=1) + "\n")
        return
    try:
        details = describe(arguments[0])
    except RlcliError as error:
        first, *more = error.message.splitlines()
        details = Details(broken=f"{first[:200]} (and {len(more)} more)" if more else first[:200])
    sys.stdout.write("\n" + json.dumps(details.record()) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])

"""Registration of every installed task with Gymnasium as `rlcli/NAME`, done when this module is imported.

`gym.make_vec("rlcli.gym:rlcli/cartpole", num_envs=8)` imports this module automatically. The code of a task is imported
when its environment is made. If several installed packages have a task of the same name, the ids are
`rlcli/DISTRIBUTION.NAME`. The id `rlcli/task` is for a task that is not installed: its argument `task` is the folder.
"""

from collections import Counter

import gymnasium

from rlcli.registry import catalog

_ADAPTER = "rlcli.adapters.gymnasium"


def register_all() -> list[str]:
    """Register all installed tasks, and the id `rlcli/task`, with Gymnasium; return all ids."""
    entries, _ = catalog()
    shared = Counter(entry.name for entry in entries)
    tasks: dict[str, dict[str, str]] = {"task": {}}
    for entry in entries:
        alone = shared[entry.name] == 1
        tasks[entry.name if alone else f"{entry.distribution}.{entry.name}"] = {
            "task": entry.name if alone else entry.qualified
        }
    ids = []
    for name, settings in tasks.items():
        ids.append(f"rlcli/{name}")
        if ids[-1] not in gymnasium.registry:
            gymnasium.register(
                ids[-1],
                entry_point=f"{_ADAPTER}:make_single",
                vector_entry_point=f"{_ADAPTER}:make_vector",
                kwargs=settings,
            )
    return ids


IDS = register_all()
"""Ids of all registered environments."""

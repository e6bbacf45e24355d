"""Importing this registers every installed task with Gymnasium, as `rlcli/NAME`.

`gym.make_vec("rlcli.gym:rlcli/cartpole", num_envs=8)` imports it by itself. No task is imported before it is made.
A name that two plugins share becomes `rlcli/DISTRIBUTION.NAME`; `rlcli/task` takes the folder of a task as `task`.
"""

from __future__ import annotations

from collections import Counter

import gymnasium

from rlcli.registry import catalog

_ADAPTER = "rlcli.adapters.gymnasium"


def register_all() -> list[str]:
    """Register what is installed; returns the ids."""
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

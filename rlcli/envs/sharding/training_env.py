"""Function `make_training_env`, which builds the environment of a training, in one process or in several.

The setting `scene.workers` determines the number of processes.
"""

from __future__ import annotations

from rlcli.config.load import Resolved
from rlcli.envs.environment_protocol import Environment
from rlcli.envs.make import make_env
from rlcli.envs.sharding.worker_count import number_of_workers


def make_training_env(resolved: Resolved, *, seed: int, device: str) -> Environment:
    """Return the environment of a training, stepped by the number of processes that `scene.workers` sets.

    Raises:
        ConfigError: if the task cannot run in several processes.
    """
    workers = number_of_workers(resolved, device)
    if workers == 1:
        return make_env(resolved, seed=seed, device=device)
    from rlcli.envs.sharding.env import ShardedEnv

    return ShardedEnv(resolved, workers=workers, seed=seed)

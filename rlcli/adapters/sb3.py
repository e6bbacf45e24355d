"""Function `make_sb3`, which returns the environments of a task as a Stable-Baselines3 `VecEnv`.

It is for scripts that call Stable-Baselines3 themselves, instead of `rlcli train`.
"""

from typing import Any

from rlcli.adapters.gymnasium import Changes, open_task
from rlcli.rl.sb3.vec_env import Sb3VecEnv

__all__ = ["Sb3VecEnv", "make_sb3"]


def make_sb3(
    task: str, num_envs: int = 1, cfg: Changes = None, *, action_bound: float | None = 1.0, **settings: Any
) -> Sb3VecEnv:
    """Return the environments of a task as an SB3 `VecEnv`. Arguments: see `rlcli.adapters.gymnasium.open_task`."""
    return Sb3VecEnv(open_task(task, num_envs, cfg, **settings), action_bound)

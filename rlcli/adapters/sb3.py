"""Function `make_sb3`, which returns the environments of a task as a Stable-Baselines3 `VecEnv`.

The function is for scripts that train with Stable-Baselines3 themselves, instead of with `rlcli train`.
"""

from typing import Any

from rlcli.adapters.gymnasium import Changes, open_task
from rlcli.rl.sb3.vec_env import Sb3VecEnv

__all__ = ["Sb3VecEnv", "make_sb3"]


def make_sb3(
    task: str, num_envs: int = 1, cfg: Changes = None, *, action_bound: float | None = 1.0, **settings: Any
) -> Sb3VecEnv:
    """Return the environments of a task as a Stable-Baselines3 `VecEnv`.

    The action space is [-action_bound, action_bound]; None: unbounded. The other arguments are those of
    `rlcli.adapters.gymnasium.open_task`; `settings` are `agent`, `seed` and `device`.
    """
    return Sb3VecEnv(open_task(task, num_envs, cfg, **settings), action_bound)

"""Environments of a task for Stable-Baselines3's own scripts."""

from __future__ import annotations

from typing import Any

from rlcli.adapters.gymnasium import Changes, open_task
from rlcli.rl.sb3.vec_env import Sb3VecEnv

__all__ = ["Sb3VecEnv", "make_sb3"]


def make_sb3(
    task: str, num_envs: int = 1, cfg: Changes = None, *, action_bound: float | None = 1.0, **settings: Any
) -> Sb3VecEnv:
    """Return the environments of a task; see `rlcli.adapters.gymnasium.open_task` for the arguments."""
    return Sb3VecEnv(open_task(task, num_envs, cfg, **settings), action_bound)

"""A `VecEnv` as Stable-Baselines3 wants it: numpy arrays and one info dict an environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv as Sb3Base

from rlcli.adapters.gymnasium import Changes, open_task
from rlcli.envs.step import StepResult
from rlcli.envs.vec_env import VecEnv

UNBOUNDED = 1e6
"""Stands for an infinite action bound: SB3 wants finite ones."""


class Sb3VecEnv(Sb3Base):
    """The policy group of a `VecEnv`. Environments without news share one empty info.

    Args:
        env: the environment.
        action_bound: limits of the action space; None for unbounded.
    """

    def __init__(self, env: VecEnv, action_bound: float | None = 1.0) -> None:
        self.env = env
        bound = UNBOUNDED if action_bound is None else action_bound
        super().__init__(
            env.num_envs,
            spaces.Box(-np.inf, np.inf, (env.layout.size("policy"),), np.float32),
            spaces.Box(-bound, bound, (env.layout.action_size,), np.float32),
        )
        self._nothing: dict[str, Any] = {}
        self._action = torch.zeros(env.num_envs, env.layout.action_size)

    def reset(self) -> np.ndarray:
        """Start new episodes everywhere; a seed given before holds once. (num_envs, d)"""
        seed = self._seeds[0]
        self._reset_seeds()
        return self.env.reset(seed=seed)["policy"].numpy()

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions. (num_envs, a)"""
        self._action = torch.as_tensor(actions, dtype=torch.float32)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step; see SB3's `VecEnv.step`."""
        result = self.env.step(self._action)
        dones = (result.terminated | result.truncated).numpy()
        return result.obs["policy"].numpy(), result.reward.numpy(), dones, self._infos(result)

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The attribute of the batched environment, once an index."""
        value = None if attr_name == "render_mode" else getattr(self.env, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the batched environment."""
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Call a method of the batched environment, once."""
        value = getattr(self.env, method_name)(*args, **kwargs)
        return [value for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """No environment is wrapped."""
        return [False for _ in self._get_indices(indices)]

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """The seed of the next reset; it seeds every environment, each with its own stream."""
        self._seeds = [seed] * self.num_envs
        return self._seeds

    def _infos(self, result: StepResult) -> list[dict[str, Any]]:
        infos = [self._nothing] * self.num_envs
        if result.episodes is not None and result.final_obs is not None:
            final = result.final_obs["policy"].numpy()
            ended = result.episodes.ended()
            for row, env in enumerate(ended.ids.tolist()):
                infos[env] = {
                    "terminal_observation": final[env].copy(),
                    "TimeLimit.truncated": bool(ended.truncated[row]),
                    "episode": {"r": float(ended.returns[row]), "l": int(ended.lengths[row])},
                }
                if ended.success is not None:
                    infos[env]["is_success"] = bool(ended.success[row])
        return infos


def make_sb3(
    task: str, num_envs: int = 1, cfg: Changes = None, *, action_bound: float | None = 1.0, **settings: Any
) -> Sb3VecEnv:
    """Environments of a task for SB3's own scripts; see `rlcli.adapters.gymnasium.open_task` for the arguments."""
    return Sb3VecEnv(open_task(task, num_envs, cfg, **settings), action_bound)

"""Adapter that gives rlcli's environments the interface of Stable-Baselines3's (SB3's) `VecEnv`.

The trainer `sb3` passes the adapter to SB3's algorithms; `rlcli.adapters.sb3` returns it to scripts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv as Sb3Base

from rlcli.envs.environment_protocol import Environment
from rlcli.envs.step_result import StepResult

UNBOUNDED = 1e6
"""Action bound for unbounded actions: SB3 requires a finite bound."""


class Sb3VecEnv(Sb3Base):
    """SB3 `VecEnv` with the observation group `policy` of rlcli's environments on a CPU; arrays are numpy, float32.

    Args:
        env: the environment.
        action_bound: the action space is [-action_bound, action_bound]; None: a bound so large that it has no effect.
    """

    def __init__(self, env: Environment, action_bound: float | None = 1.0) -> None:
        self.env = env
        bound = UNBOUNDED if action_bound is None else action_bound
        super().__init__(
            env.num_envs,
            spaces.Box(-np.inf, np.inf, (env.layout.size("policy"),), np.float32),
            spaces.Box(-bound, bound, (env.layout.action_size,), np.float32),
        )
        self._empty_info: dict[str, Any] = {}
        self._action = torch.zeros(env.num_envs, env.layout.action_size)

    def reset(self) -> np.ndarray:
        """Start new episodes in all environments; return the observations. (num_envs, d) float32

        If `seed` was called, the episodes start from that seed; a later reset does not use it again.
        """
        seed = self._seeds[0]
        self._reset_seeds()
        return self.env.reset(seed=seed)["policy"].numpy()

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions of the next step. (num_envs, a)"""
        self._action = torch.as_tensor(actions, dtype=torch.float32)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step all environments with the actions of `step_async`.

        Returns:
            Observations (num_envs, d) and rewards (num_envs,) float32, dones (num_envs,) bool, and one info dict for
            each environment, with SB3's keys (`terminal_observation`, `TimeLimit.truncated`, ...) if its episode ended.
        """
        result = self.env.step(self._action)
        dones = (result.terminated | result.truncated).numpy()
        return result.obs["policy"].numpy(), result.reward.numpy(), dones, self._infos(result)

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return the value of an attribute of the vectorised environment, once for each index."""
        value = None if attr_name == "render_mode" else getattr(self.env, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: object, indices: object = None) -> None:
        """Set an attribute of the vectorised environment; `indices` has no effect."""
        setattr(self.env, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Call a method of the vectorised environment once; return its result once for each index."""
        value = getattr(self.env, method_name)(*args, **kwargs)
        return [value for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return False for every index: no environment is wrapped."""
        return [False for _ in self._get_indices(indices)]

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seed of the next reset; every environment derives its own random stream from it."""
        self._seeds = [seed] * self.num_envs
        return self._seeds

    def _infos(self, result: StepResult) -> list[dict[str, Any]]:
        infos = [self._empty_info] * self.num_envs  # all environments share one dict, because most steps end no episode
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

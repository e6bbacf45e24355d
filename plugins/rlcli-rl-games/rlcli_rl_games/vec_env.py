"""Adapter that gives an rlcli environment the interface of rl_games."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rlcli.envs.environment_protocol import Environment
from rlcli.envs.step_result import StepResult
from rlcli.rl.episode_statistics import EpisodeStatistics
from rlcli_rl_games.library import IVecEnv, gym


class RlGamesVecEnv(IVecEnv):
    """A `VecEnv` with the interface of rl_games.

    Args:
        env: the environment.
        statistics: statistics of the episodes that end.
        central: whether the observation group `critic` is passed as `states`.
        time_outs: whether time-outs are passed to rl_games, which then bootstraps in its own way.
        threads: threads of torch outside of the environment's step; the step itself runs on one thread.
    """

    def __init__(
        self, env: Environment, statistics: EpisodeStatistics, *, central: bool, time_outs: bool, threads: int
    ) -> None:
        self.env, self.central, self.time_outs, self.threads = env, central, time_outs, threads
        self.statistics = statistics
        self.result: StepResult | None = None

    def step(self, actions: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, dict[str, Tensor]]:
        """Step every environment; return (observations, reward, done, infos) in rl_games' form."""
        torch.set_num_threads(1)
        self.result = step = self.env.step(actions)
        torch.set_num_threads(self.threads)
        self.statistics.add(step.episodes)
        infos = {"time_outs": self.timed_out} if self.time_outs else {}
        return self.observe(step.obs), step.reward, (step.terminated | step.truncated).to(torch.uint8), infos

    def reset(self) -> dict[str, Tensor]:
        """Reset the environment, and return its first observations in rl_games' form."""
        return self.observe(self.env.reset(seed=self.env.seed))

    def observe(self, groups: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return observations, given by group, in rl_games' form: `obs`, and `states` for a separate critic."""
        return {"obs": groups["policy"], **({"states": groups["critic"]} if self.central else {})}

    @property
    def timed_out(self) -> Tensor:
        """Return where the last step truncated an episode without terminating it. (num_envs,) bool"""
        assert self.result is not None
        return self.result.truncated & ~self.result.terminated

    def get_env_info(self) -> dict[str, Any]:
        """Return the observation and action spaces, with actions in +-1."""
        return self.spaces(1.0)

    def spaces(self, bound: float) -> dict[str, Any]:
        """Return the observation and action spaces, with actions in +-bound."""

        def box(size: int, limit: float) -> Any:
            return gym.spaces.Box(-limit, limit, (size,), np.float32)

        layout = self.env.layout
        info = {"observation_space": box(layout.size("policy"), np.inf), "action_space": box(layout.action_size, bound)}
        return {**info, "state_space": box(layout.size("critic"), np.inf)} if self.central else info

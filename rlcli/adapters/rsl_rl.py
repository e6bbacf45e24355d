"""Adapter that gives a `VecEnv` the interface of RSL-RL's environments, so that RSL-RL's runners can train in it."""

from typing import Any

import torch
from rsl_rl.env import VecEnv as RslRlBase
from tensordict import TensorDict
from torch import Tensor

from rlcli.envs.environment_protocol import Environment
from rlcli.rl.episode_statistics import EpisodeStatistics


class RslRlVecEnv(RslRlBase):  # type: ignore[misc]  # RSL-RL has no types
    """Environment for RSL-RL's runners, with all observation groups of a `VecEnv`.

    The first call of `get_observations` starts the first episodes. The extras of `step` have `time_outs`, true for
    episodes that were truncated and not terminated; for these, RSL-RL bootstraps from the value of the observation
    before the step. The last observations of episodes are in `extras["final_obs"]`, which RSL-RL does not read.

    Args:
        env: the environment.
        clip_actions: actions are clipped to +-`clip_actions`; None: no clipping.
    """

    def __init__(self, env: Environment, clip_actions: float | None = None) -> None:
        self.unwrapped = env
        self.clip_actions = clip_actions
        self.num_envs = env.num_envs
        self.num_actions = env.layout.action_size
        self.max_episode_length = env.max_episode_length
        self.device = env.device
        self.cfg = env.config.model_dump(mode="json")
        self._obs: TensorDict | None = None
        self._statistics = EpisodeStatistics(env.config.episode_length_s)

    @property
    def episode_length_buf(self) -> Tensor:
        """Number of steps of each environment's current episode. (num_envs,) int64"""
        return self.unwrapped.episode_length_buf

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        self.unwrapped.episode_length_buf.copy_(value)

    def reset(self) -> tuple[TensorDict, dict[str, Any]]:
        """Start new episodes in all environments; return the observations by group, and empty extras."""
        self._obs = self.observations(self.unwrapped.reset())
        return self._obs, {}

    def get_observations(self) -> TensorDict:
        """Return the observations by group. (num_envs, d) each"""
        if self._obs is None:
            self._obs = self.observations(self.unwrapped.reset(seed=self.unwrapped.seed))
        return self._obs

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Step all environments. actions (num_envs, a)

        Returns:
            Observations by group, rewards (num_envs,), dones (num_envs,) int64, and extras. The extras have `time_outs`
            (num_envs,) bool and, in steps in which episodes end, `final_obs` and `log` (statistics of these episodes).
        """
        if self._obs is None:
            self.get_observations()
        bound = self.clip_actions
        result = self.unwrapped.step(actions if bound is None else actions.clamp(-bound, bound))
        self._obs = self.observations(result.obs)
        extras: dict[str, Any] = {"time_outs": result.truncated & ~result.terminated}
        if result.final_obs is not None:
            extras["final_obs"] = self.observations(result.final_obs)
        if result.episodes is not None and len(result.episodes.ended().ids):
            self._statistics.add(result.episodes)
            extras["log"] = self._statistics.flush()
        return self._obs, result.reward, (result.terminated | result.truncated).long(), extras

    def observations(self, groups: dict[str, Tensor]) -> TensorDict:
        """Return observation groups, tensors (num_envs, d) by name, as the `TensorDict` that RSL-RL uses."""
        return TensorDict(dict(groups), batch_size=[self.num_envs], device=self.device)

    def zero_observations(self) -> TensorDict:
        """Return observations of all groups that are zero, for code that only needs their shapes. (num_envs, d) each"""
        layout = self.unwrapped.layout
        return self.observations(
            {group: torch.zeros(self.num_envs, layout.size(group), device=self.device) for group in layout.observations}
        )

    def close(self) -> None:
        """Close the environment."""
        self.unwrapped.close()

"""Stable-Baselines3's algorithms on a rollout that stays in torch: their own updates, our own way to collect.

Only public hooks are used: buffers given to the constructors, `collect_rollouts` and `train`.
"""

from __future__ import annotations

from typing import Any

import torch
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.rl.policy import Normalizer
from rlcli.rl.sb3_buffers import TorchReplayBuffer, TorchRolloutBuffer
from rlcli.rl.statistics import EpisodeStatistics


class _Source:
    """What every collector needs, set once the model is built."""

    source: VecEnv
    statistics: EpisodeStatistics
    normalizer: Normalizer | None
    reward_scale: float
    action_bound: float | None

    def _see(self, obs: Tensor, update: bool) -> Tensor:
        if self.normalizer is None:
            return obs
        if update:
            self.normalizer.update(obs)
        return self.normalizer(obs)


class _OnPolicy(_Source):
    """Collects rollouts; all time-outs of a step are bootstrapped by one call of the critic."""

    rollout_buffer: TorchRolloutBuffer
    policy: Any
    gamma: float
    num_timesteps: int
    _last_obs: Any
    _last_episode_starts: Any

    def collect_rollouts(self, env: Any, callback: Any, rollout_buffer: Any, n_rollout_steps: int) -> bool:
        """Fill the buffer with `n_rollout_steps` of every environment."""
        buffer, source, policy, bound = self.rollout_buffer, self.source, self.policy, self.action_bound
        policy.set_training_mode(False)
        buffer.reset()
        obs, start = torch.as_tensor(self._last_obs), torch.as_tensor(self._last_episode_starts)
        done = start
        with torch.inference_mode():
            for _ in range(n_rollout_steps):
                seen = self._see(obs, update=True)
                action, value, log_prob = policy(seen)
                result = source.step(action if bound is None else action.clamp(-bound, bound))
                reward = result.reward * self.reward_scale
                if result.final_obs is not None:
                    cut = (result.truncated & ~result.terminated).nonzero().squeeze(1)
                    final = self._see(result.final_obs["policy"].index_select(0, cut), update=False)
                    reward.index_add_(0, cut, policy.predict_values(final).flatten(), alpha=self.gamma)
                buffer.put(seen, action, reward, start, value.flatten(), log_prob)
                self.statistics.add(result.episodes)
                done = result.terminated | result.truncated
                obs, start = result.obs["policy"], done
            buffer.finish(policy.predict_values(self._see(obs, update=False)).flatten(), done)
        self.num_timesteps += n_rollout_steps * source.num_envs
        self._last_obs = obs.numpy()
        self._last_episode_starts = start.numpy()
        return True


class FastPPO(_OnPolicy, PPO):  # type: ignore[misc]
    """SB3's PPO."""


class FastA2C(_OnPolicy, A2C):  # type: ignore[misc]
    """SB3's A2C."""


class _OffPolicy(_Source):
    """Collects transitions. Actions in the buffer are in [-1, 1]; the environment gets them times the bound."""

    replay_buffer: TorchReplayBuffer
    actor: Any
    learning_starts: int
    num_timesteps: int
    exploration_noise: float
    _last_obs: Any

    def collect(self, steps: int) -> None:
        """Step every environment `steps` times into the replay buffer; random actions before `learning_starts`."""
        assert self.action_bound is not None
        source, buffer = self.source, self.replay_buffer
        self.policy.set_training_mode(False)  # type: ignore[attr-defined]
        obs = torch.as_tensor(self._last_obs)
        with torch.inference_mode():
            for _ in range(steps):
                seen = self._see(obs, update=True)
                if self.num_timesteps < self.learning_starts:
                    action = torch.rand(source.num_envs, source.layout.action_size) * 2.0 - 1.0
                else:
                    action = self._explore(seen)
                result = source.step(action * self.action_bound)
                following = result.obs["policy"]
                if result.final_obs is not None:
                    cut = result.truncated & ~result.terminated
                    following = torch.where(cut[:, None], result.final_obs["policy"], following)
                buffer.put(obs, following, action, result.reward * self.reward_scale, result.terminated)
                self.statistics.add(result.episodes)
                obs = result.obs["policy"]
                self.num_timesteps += source.num_envs
        self._last_obs = obs.numpy()

    def _explore(self, seen: Tensor) -> Tensor:
        action = self.actor(seen)  # SAC's samples; the others' are deterministic
        if not self.exploration_noise:
            return action
        return (action + self.exploration_noise * torch.randn_like(action)).clamp_(-1.0, 1.0)


class FastSAC(_OffPolicy, SAC):  # type: ignore[misc]
    """SB3's SAC."""


class FastTD3(_OffPolicy, TD3):  # type: ignore[misc]
    """SB3's TD3."""


class FastDDPG(_OffPolicy, DDPG):  # type: ignore[misc]
    """SB3's DDPG."""

"""Subclasses of Stable-Baselines3's algorithms that keep SB3's updates, but store rollouts as torch tensors.

SB3 itself would copy each step to numpy. Only public hooks of SB3 are used: buffers passed to the constructors,
`collect_rollouts` and `train`.
"""

from __future__ import annotations

from typing import Any

import torch
from stable_baselines3 import A2C, DDPG, PPO, SAC, TD3
from torch import Tensor

from rlcli.envs.environment_protocol import Environment
from rlcli.rl.episode_statistics import EpisodeStatistics
from rlcli.rl.policy import Normalizer
from rlcli.rl.sb3.buffers import TorchReplayBuffer, TorchRolloutBuffer


class _Collecting:
    """Base of on-policy and off-policy algorithms: attributes that the trainer sets after it has built the model."""

    source: Environment
    statistics: EpisodeStatistics
    normalizer: Normalizer | None
    reward_scale: float
    action_bound: float | None
    # attributes of SB3's algorithms
    policy: Any
    num_timesteps: int
    _last_obs: Any

    def _normalized(self, obs: Tensor, update: bool) -> Tensor:
        if self.normalizer is None:
            return obs
        if update:
            self.normalizer.update(obs)
        normalized: Tensor = self.normalizer(obs)
        return normalized


class _OnPolicy(_Collecting):
    """Collection of rollouts for PPO and A2C; the critic is called once for all time-outs of a step."""

    rollout_buffer: TorchRolloutBuffer
    gamma: float
    _last_episode_starts: Any

    def collect_rollouts(self, env: object, callback: object, rollout_buffer: object, n_rollout_steps: int) -> bool:
        """Fill this object's rollout buffer with `n_rollout_steps` steps of every environment; return True.

        The arguments are those of SB3's method; the other ones are not used.
        """
        buffer, source, policy, bound = self.rollout_buffer, self.source, self.policy, self.action_bound
        policy.set_training_mode(False)
        buffer.reset()
        obs, start = torch.as_tensor(self._last_obs), torch.as_tensor(self._last_episode_starts)
        with torch.inference_mode():
            for _ in range(n_rollout_steps):
                normalized = self._normalized(obs, update=True)
                action, value, log_prob = policy(normalized)
                result = source.step(action if bound is None else action.clamp(-bound, bound))
                reward = result.reward * self.reward_scale
                if result.final_obs is not None:
                    # a time-out: r += gamma V(last observation of the episode)
                    timed_out = (result.truncated & ~result.terminated).nonzero().squeeze(1)
                    final = self._normalized(result.final_obs["policy"].index_select(0, timed_out), update=False)
                    reward.index_add_(0, timed_out, policy.predict_values(final).flatten(), alpha=self.gamma)
                buffer.put(normalized, action, reward, start, value.flatten(), log_prob)
                self.statistics.add(result.episodes)
                obs, start = result.obs["policy"], result.terminated | result.truncated
            buffer.finish(policy.predict_values(self._normalized(obs, update=False)).flatten(), start)
        self.num_timesteps += n_rollout_steps * source.num_envs
        self._last_obs = obs.numpy()
        self._last_episode_starts = start.numpy()
        return True


class FastPPO(_OnPolicy, PPO):  # type: ignore[misc]
    """SB3's PPO with rollouts in torch."""


class FastA2C(_OnPolicy, A2C):  # type: ignore[misc]
    """SB3's A2C with rollouts in torch."""


class _OffPolicy(_Collecting):
    """Collection of transitions for SAC, TD3 and DDPG.

    The buffer holds actions in [-1, 1]; the environment receives them multiplied by the action bound.
    """

    replay_buffer: TorchReplayBuffer
    actor: Any
    learning_starts: int
    exploration_noise: float

    def collect(self, steps: int) -> None:
        """Do `steps` steps of every environment; before `learning_starts` the actions are uniformly random."""
        assert self.action_bound is not None
        source, buffer = self.source, self.replay_buffer
        self.policy.set_training_mode(False)
        obs = torch.as_tensor(self._last_obs)
        with torch.inference_mode():
            for _ in range(steps):
                normalized = self._normalized(obs, update=True)
                if self.num_timesteps < self.learning_starts:
                    action = torch.rand(source.num_envs, source.layout.action_size) * 2.0 - 1.0
                else:
                    action = self._explore(normalized)
                result = source.step(action * self.action_bound)
                following = result.obs["policy"]
                if result.final_obs is not None:
                    timed_out = result.truncated & ~result.terminated
                    following = torch.where(timed_out[:, None], result.final_obs["policy"], following)
                buffer.put(obs, following, action, result.reward * self.reward_scale, result.terminated)
                self.statistics.add(result.episodes)
                obs = result.obs["policy"]
                self.num_timesteps += source.num_envs
        self._last_obs = obs.numpy()

    def _explore(self, normalized: Tensor) -> Tensor:
        action: Tensor = self.actor(normalized)  # SAC samples here; the actors of TD3 and DDPG are deterministic
        if not self.exploration_noise:
            return action
        return (action + self.exploration_noise * torch.randn_like(action)).clamp_(-1.0, 1.0)


class FastSAC(_OffPolicy, SAC):  # type: ignore[misc]
    """SB3's SAC with rollouts in torch."""


class FastTD3(_OffPolicy, TD3):  # type: ignore[misc]
    """SB3's TD3 with rollouts in torch."""


class FastDDPG(_OffPolicy, DDPG):  # type: ignore[misc]
    """SB3's DDPG with rollouts in torch."""

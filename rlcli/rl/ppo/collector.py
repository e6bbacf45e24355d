"""Collect the rollouts of the PPO trainer, and estimate the advantages of their samples.

The methods `collect` and `estimate_advantages` of `Collector` have no arguments and no results. They work on
preallocated tensors and never read a value back from the device, so that a GPU can capture each of them as a CUDA graph
and replay it.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from rlcli.envs.environment_protocol import Environment
from rlcli.envs.mirror import MirrorMaps
from rlcli.envs.step_result import StepResult
from rlcli.rl import distributed
from rlcli.rl.episode_statistics import EpisodeStatistics
from rlcli.rl.nan_check import moments, require_finite
from rlcli.rl.policy import Normalizer
from rlcli.rl.ppo.config import PpoConfig
from rlcli.rl.ppo.loss import log_prob, standardize
from rlcli.rl.ppo.networks import ActorCritic, ValueNormalizer, unroll
from rlcli.rl.ppo.rollout_buffer import RolloutBuffer
from rlcli.rl.ppo.setup import minibatch_sizes


class Collector:
    """Collector of rollouts with the current policy, which also estimates the advantages of the samples.

    Args:
        env: the environment.
        config: configuration of the agent.
        networks: actor and critic.
        statistics: statistics of finished episodes.
        mirror: maps from observations and actions to their mirror images; None if the agent does not use the symmetry
            of the robot.
    """

    def __init__(
        self,
        env: Environment,
        config: PpoConfig,
        networks: ActorCritic,
        statistics: EpisodeStatistics,
        mirror: MirrorMaps | None = None,
    ) -> None:
        self.env, self.config, self.networks, self.mirror = env, config, networks, mirror
        self.statistics, self.process_group = statistics, distributed.current()
        device, layout = env.device, env.layout
        self.iteration = 0
        """Number of finished iterations; the trainer increases it before the update."""
        self.checks_every_stage = device.type == "cpu"
        """Whether tensors are checked for NaN after every stage.

        True on a CPU. On a GPU tensors are checked only once per iteration, because each check waits for the GPU."""
        groups = networks.critic_groups
        self._critic_reads_actor_obs = groups == ("policy",)
        obs_size, critic_size = layout.size("policy"), sum(layout.size(group) for group in groups)

        normalizes_critic_obs = config.normalize_observations and not self._critic_reads_actor_obs
        self.normalizer = Normalizer(obs_size).to(device) if config.normalize_observations else None
        self.critic_normalizer = Normalizer(critic_size).to(device) if normalizes_critic_obs else None
        self.value_normalizer = ValueNormalizer().to(device) if config.normalize_value else None

        sizes = (obs_size, 0 if self._critic_reads_actor_obs else critic_size, layout.action_size)
        steps, minibatches = config.num_steps, minibatch_sizes(env, config, config.num_steps * env.num_envs)
        whole_envs, mirrored = config.rnn is not None, mirror is not None
        self.rollout = RolloutBuffer(steps, env.num_envs, sizes, minibatches, whole_envs, device, mirrored)
        self.obs = {
            group: torch.zeros(env.num_envs, layout.size(group), device=device)
            for group in dict.fromkeys(("policy", *groups))
        }
        """Current observations by group; the next action depends on them. (num_envs, d) each"""
        self.raw_obs = {
            group: torch.zeros(config.num_steps, *obs.shape, device=device)
            for group, obs in self.obs.items()
            if config.normalize_observations
        }
        """Observations of the rollout before normalisation, by group. (num_steps, num_envs, d) each"""
        self.episode_start = torch.ones(env.num_envs, device=device)
        """1 where `obs` is the first observation of an episode, 0 elsewhere. (num_envs,)"""
        self.hidden_state = {name: lstm.blank(env.num_envs) for name, lstm in networks.recurrent_modules().items()}
        """Current hidden states of the LSTMs of actor and critic. (num_envs, m) each"""
        self.initial_hidden_state = {name: state.clone() for name, state in self.hidden_state.items()}
        """Hidden states of the LSTMs of actor and critic at the beginning of the rollout. (num_envs, m) each"""
        self.explained_variance = torch.zeros((), device=device)
        """Explained variance of the critic: 1 - Var(target - value) / Var(target). (scalar)"""

    # --- the rollout ---

    @torch.no_grad()
    def collect(self) -> None:
        """Do `num_steps` steps in every environment with the current policy, and store the samples in `rollout`."""
        rollout, samples, bound = self.rollout, self.rollout.samples, self.config.action_bound
        for name, state in self.hidden_state.items():
            self.initial_hidden_state[name].copy_(state)
        # one call that samples the noise of all steps is faster than a call in each step
        std, noise = self.networks.std, torch.randn_like(samples.action)
        deviation = std * noise
        samples.log_prob.copy_(log_prob(noise, std))
        raw_obs, episode_start = self.obs, self.episode_start
        for t in range(self.config.num_steps):
            obs, critic_obs = self._inputs(t, raw_obs)
            mean = self.networks.mean(self._actor_features(obs, episode_start))
            action = mean + deviation[t]
            step = self.env.step(action if bound is None else action.clamp(-bound, bound))
            samples.obs[t].copy_(obs)
            if samples.critic_obs is not samples.obs:
                samples.critic_obs[t].copy_(critic_obs)
            samples.action[t].copy_(action)
            samples.mean[t].copy_(mean)
            self._store_outcome(t, step)
            raw_obs, episode_start = step.obs, rollout.done[t]  # a step returns the new episode's first observation
        self.set_obs(raw_obs)
        samples.episode_start[0].copy_(self.episode_start)
        samples.episode_start[1:].copy_(rollout.done[:-1])
        self.episode_start.copy_(episode_start)
        rollout.old_std.copy_(std.expand_as(rollout.old_std))

    def set_obs(self, obs: Mapping[str, Tensor]) -> None:
        """Copy new observations, by group, into the current ones, after a reset or a rollout. (num_envs, d) each"""
        for group, own in self.obs.items():
            own.copy_(obs[group])

    def _inputs(self, t: int, obs: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Return the normalised inputs of actor and critic at step t, and store the raw observations.

        With `normalizer_update: step` the raw observations also update the normalisers, before they are used.
        """
        if self.normalizer is not None:
            for group, raw in self.raw_obs.items():
                raw[t].copy_(obs[group])
            if self.config.normalizer_update == "step":
                self.update_normalizers(obs)
        if self.mirror is not None and self.rollout.images is not None:
            image = {group: self.mirror.observations[group](obs[group]) for group in self.obs}
            self.rollout.images.obs[t].copy_(self.actor_input(image))
            if not self._critic_reads_actor_obs:
                self.rollout.images.critic_obs[t].copy_(self._critic_input(image))
        return self.actor_input(obs), self._critic_input(obs)

    def _actor_features(self, obs: Tensor, episode_start: Tensor) -> Tensor:
        """Return the input of the actor's MLP: the observation, or the LSTM's output for it, which advances its state.

        `episode_start` is 1 where the hidden state must be zero. (num_envs, d), (num_envs,) -> (num_envs, features)
        """
        if self.networks.memory is None:
            return obs
        state = self.hidden_state["actor"]
        features: Tensor
        features, next_state = self.networks.memory(obs, state * (1.0 - episode_start)[:, None])
        state.copy_(next_state)
        return features

    def _store_outcome(self, t: int, step: StepResult) -> None:
        """Store rewards, ends of episodes and last observations of step t; add ended episodes to the statistics."""
        rollout = self.rollout
        torch.mul(step.reward, self.config.reward_scale, out=rollout.reward[t])
        torch.logical_or(step.terminated, step.truncated, out=rollout.done[t])
        torch.gt(step.truncated, step.terminated, out=rollout.time_out[t])  # truncated and not terminated
        if step.final_obs is not None and self.config.bootstrap == "final_obs":
            rollout.final_obs[t].copy_(self._critic_input(step.final_obs))
        self.statistics.add(step.episodes)

    # --- the advantages ---

    @torch.no_grad()
    def estimate_advantages(self) -> None:
        """Estimate advantages and targets by GAE, equations 11 and 12 of Schulman et al. 2017 (PPO):

            delta_t = r_t + gamma V(s_t+1) - V(s_t)                             (12)
            A_t     = delta_t + gamma lambda A_t+1                              (11, as a recursion)

        At the end of an episode both V(s_t+1) and A_t+1 are 0. At a time-out the reward r_t gets an additional
        gamma V(last observation of the episode), or gamma V(s_t) with `bootstrap: pre_step`. The regression target of
        the critic is A_t + V(s_t).
        """
        config, rollout, samples = self.config, self.rollout, self.rollout.samples
        values = self._values() if self.networks.memory is None else self._recurrent_values()
        value, last_value, time_out_value = values
        if config.bootstrap == "pre_step":
            time_out_value = value * rollout.time_out
        reward, not_done = rollout.reward + config.gamma * time_out_value, 1.0 - rollout.done
        next_value = torch.cat([value[1:], last_value[None]])
        delta = reward + config.gamma * next_value * not_done - value  # equation 12
        decay, advantage = config.gamma * config.lam * not_done, torch.zeros_like(last_value)
        for t in reversed(range(config.num_steps)):
            advantage = torch.addcmul(delta[t], decay[t], advantage, out=samples.advantage[t])  # equation 11
        samples.value.copy_(value)
        torch.add(samples.advantage, value, out=samples.target)
        if self.checks_every_stage and not rollout.is_finite():
            require_finite(self.rollout_dependencies(), self.iteration)
            self.require_finite_rollout()
        self.explained_variance.copy_(1.0 - (samples.target - value).var() / samples.target.var())
        if self.value_normalizer is not None:
            # in this order: the old values are normalised before the targets change the statistics
            for column in (samples.value, samples.target):
                self._update_normalizer(self.value_normalizer, column.flatten())
                column.copy_(self.value_normalizer(column))
        if config.normalize_advantage == "batch":
            samples.advantage.copy_(standardize(samples.advantage, self.process_group))

    def _values(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the critic's values that GAE needs.

        Returns:
            The values of the rollout's observations, (num_steps, num_envs); of the observations after the rollout,
            (num_envs,); and of the last observations before time-outs, 0 elsewhere, (num_steps, num_envs).
        """
        rollout = self.rollout
        value, last_value = self._value(rollout.samples.critic_obs), self._value(self._critic_input(self.obs))
        return value, last_value, self._value_where(rollout.time_out, rollout.final_obs)

    def _recurrent_values(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the values that `_values` describes, for a critic with an LSTM; advance its hidden state."""
        lstm, state, rollout = self.networks.critic_memory, self.hidden_state["critic"], self.rollout
        assert lstm is not None
        features, states = unroll(lstm, rollout.samples.critic_obs, rollout.samples.episode_start, state)
        finals = [lstm(obs, before)[0] for obs, before in zip(rollout.final_obs, states, strict=True)]
        state.copy_(states[-1])
        last, _ = lstm(self._critic_input(self.obs), state * (1.0 - self.episode_start)[:, None])
        time_out_value = torch.where(rollout.time_out, self._value(torch.stack(finals)), 0.0)
        return self._value(features), self._value(last), time_out_value

    def _value(self, critic_obs: Tensor) -> Tensor:
        """Return the critic's value in the unit of the rewards, without normalisation. (..., c) -> (...)"""
        value: Tensor = self.networks.value(critic_obs)
        return value if self.value_normalizer is None else self.value_normalizer.inverse(value)

    def _value_where(self, mask: Tensor, critic_obs: Tensor) -> Tensor:
        """Return the critic's value where the mask is true, 0 elsewhere. (...), (..., c) -> (...)

        On a CPU only the masked values are computed. On a GPU all are: selecting rows would force a host sync.
        """
        if self.env.device.type == "cpu":
            value = torch.zeros(mask.shape)
            value[mask] = self._value(critic_obs[mask])
            return value
        return torch.where(mask, self._value(critic_obs), 0.0)

    @torch.no_grad()
    def complete_images(self) -> None:
        """Compute the mirror images of the samples; call it after `estimate_advantages`. Without symmetry do nothing.

        As in Mittal et al. 2024, a mirrored action gets the probability of the original action, because both are
        equally probable for a symmetric policy.
        """
        samples, images = self.rollout.samples, self.rollout.images
        if self.mirror is None or images is None:
            return
        images.action.copy_(self.mirror.action(samples.action))
        images.mean.copy_(self.networks.mean(images.obs))
        for name in ("log_prob", "value", "advantage", "target", "episode_start"):
            getattr(images, name).copy_(getattr(samples, name))

    # --- observations and their normalisation ---

    def actor_input(self, obs: Mapping[str, Tensor]) -> Tensor:
        """Return the group `policy`, normalised if the agent normalises observations. (n, d) -> (n, d)"""
        return obs["policy"] if self.normalizer is None else self.normalizer(obs["policy"])

    def _critic_input(self, obs: Mapping[str, Tensor]) -> Tensor:
        if self._critic_reads_actor_obs:
            return self.actor_input(obs)
        critic_obs = self._concatenated(obs)
        return critic_obs if self.critic_normalizer is None else self.critic_normalizer(critic_obs)

    def _concatenated(self, obs: Mapping[str, Tensor]) -> Tensor:
        """Return the observation groups of the critic, side by side. (num_envs, c)"""
        groups = self.networks.critic_groups
        return obs[groups[0]] if len(groups) == 1 else torch.cat([obs[group] for group in groups], dim=-1)

    def update_normalizers(self, obs: Mapping[str, Tensor]) -> None:
        """Update the normalisers of the observations with the observations of each group. (..., d) each"""
        if self.normalizer is not None:
            self._update_normalizer(self.normalizer, obs["policy"].flatten(0, -2))
        if self.critic_normalizer is not None:
            self._update_normalizer(self.critic_normalizer, self._concatenated(obs).flatten(0, -2))

    def _update_normalizer(self, normalizer: Normalizer, values: Tensor) -> None:
        """Update a normaliser with the values of this process and of all other processes of the training. (n, ...)"""
        batch, processes = values.double(), self.process_group.world_size
        mean, var = batch.mean(dim=0), batch.var(dim=0, unbiased=False)
        if processes > 1:
            mean, square = self.process_group.average_(torch.stack((mean, var + mean.square())))
            var = square - mean.square()  # Var(x) = E[x^2] - E[x]^2 over the batches of all processes
        normalizer.merge(mean, var, float(len(batch) * processes))

    # --- checks for NaN ---

    def require_finite_rollout(self) -> None:
        """Check that all samples of the rollout are finite.

        Raises:
            DivergedError: with the first sample that is not finite.
        """
        require_finite(self.rollout.in_causal_order(), self.iteration, ("step", "environment"))

    def rollout_dependencies(self) -> list[tuple[str, Tensor]]:
        """Return (name, tensor) of everything that a rollout depends on: normalisers, weights and hidden states."""
        states = [(f"the hidden state of the {name}", state) for name, state in self.initial_hidden_state.items()]
        return [*self.normalizer_moments(), *self.named_weights(), *states]

    def named_weights(self) -> list[tuple[str, Tensor]]:
        """Return (name for messages, weight) of all weights of actor and critic."""
        return [(f"weight '{name}'", parameter.detach()) for name, parameter in self.networks.named_parameters()]

    def normalizer_moments(self) -> list[tuple[str, Tensor]]:
        """Return (name for messages, tensor) of the mean, variance and count of all normalisers."""
        critic, value = ("critic's observation", self.critic_normalizer), ("value", self.value_normalizer)
        return moments([("observation", self.normalizer), critic, value])

"""rl_games' SAC as a trainer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from rlcli.rl.policy import PolicySpec
from rlcli.rl.trainer import TrainerState
from rlcli_rl_games.base import ACTIVATIONS, OBSERVATION_CLIP, RlGamesTrainer, mean_of
from rlcli_rl_games.config import SacConfig
from rlcli_rl_games.library import SACAgent, VectorizedReplayBuffer
from rlcli_rl_games.vec_env import RlGamesVecEnv

_COLUMNS = ("obses", "actions", "rewards", "next_obses", "dones")
"""Columns of the replay buffer."""


class ReplayBuffer(VectorizedReplayBuffer):
    """Replay buffer of rl_games with correct time-outs.

    A time-out is stored as not done, with the last observation of the episode as the next observation.

    Args:
        vec: the environment.
        plain: rl_games' buffer, whose storage this buffer takes over.
    """

    def __init__(self, vec: RlGamesVecEnv, plain: VectorizedReplayBuffer) -> None:
        vars(self).update(vars(plain))
        self.vec = vec

    def add(self, obs: Tensor, action: Tensor, reward: Tensor, next_obs: Tensor, done: Tensor) -> None:
        """Store one transition of every environment: a step from `obs` to `next_obs`."""
        step = self.vec.result
        assert step is not None
        if step.final_obs is not None:
            next_obs = torch.where(self.vec.timed_out[:, None], step.final_obs["policy"], next_obs)
        super().add(obs, action, reward, next_obs, step.terminated[:, None])


class SacTrainer(RlGamesTrainer):
    """Trainer for rl_games' SAC."""

    config: SacConfig

    def _make(self, parameters: dict[str, Any]) -> Any:
        config = self.config.params.config
        if config.replay_buffer_size < self.env.num_envs:
            message = (
                f"{config.replay_buffer_size} transitions are fewer than one step of {self.env.num_envs} environments"
            )
            raise self._error("replay_buffer_size", message, f"give at least {self.env.num_envs}")
        agent = SACAgent("rlcli", parameters)
        if self.bootstrap == "final_obs":
            agent.replay_buffer = ReplayBuffer(self.vec, agent.replay_buffer)
        return agent

    def _horizon(self) -> int:
        return self.config.params.config.num_steps_per_episode

    def _policy_spec(self) -> PolicySpec:
        params = self.config.params
        return PolicySpec(
            kind="squashed-gaussian-mlp",
            observation_size=self.env.layout.size("policy"),
            action_size=self.env.layout.action_size,
            hidden=params.network.mlp.units,
            activation=ACTIVATIONS.get(params.network.mlp.activation, params.network.mlp.activation),  # type: ignore[arg-type]
            action_bound=self.config.action_bound,
            normalize=params.config.normalize_input,
            normalize_clip=OBSERVATION_CLIP,
            log_std_range=params.network.log_std_bounds,
        )

    def _epoch(self) -> tuple[float, dict[str, float]]:
        agent = self.agent
        agent.epoch_num += 1
        _, _, update, _, actor, entropies, alphas, temperature, critic, _ = agent.train_epoch()
        agent.frame += agent.num_frames_per_epoch
        losses = {"actor": actor, "critic": critic, "entropy": entropies, "entropy_coefficient": alphas}
        losses["temperature"] = [value for value in temperature if value is not None]
        return update, {f"Loss/{name}": mean_of(values) for name, values in losses.items() if values}

    def state(self) -> TrainerState:
        """Return a copy of everything that the next iteration depends on."""
        state, buffer = super().state(), self.agent.replay_buffer
        state.tensors["trainer"]["log_alpha"] = self.agent.log_alpha.detach().clone()
        filled = buffer.capacity if buffer.full else buffer.idx
        state.tensors["replay"] = {name: getattr(buffer, name)[:filled].clone() for name in _COLUMNS}
        state.values |= {"replay": {"next": buffer.idx, "full": buffer.full}, "updates": self.agent.update_counter}
        return state

    def load(self, state: TrainerState) -> None:
        """Restore a saved state. On a CPU the next iteration is bit-identical to the one that followed the save."""
        buffer = self.agent.replay_buffer
        for name in _COLUMNS:
            values = state.tensors["replay"][name]
            getattr(buffer, name)[: len(values)].copy_(values)
        buffer.idx, buffer.full = state.values["replay"]["next"], state.values["replay"]["full"]
        with torch.no_grad():
            self.agent.log_alpha.copy_(state.tensors["trainer"]["log_alpha"])
        self.agent.update_counter = state.values["updates"]
        super().load(state)

    def load_weights(self, policy: Mapping[str, Tensor]) -> None:
        """Load a policy's weights, with its normaliser; the weights of the critics do not change."""
        actor, last = self.agent.model.sac_network.actor, 2 * len(self.spec.hidden)
        weights = {}
        for name in actor.state_dict():
            _, index, kind = name.split(".")
            parts = [policy[f"actor.{index}.{kind}"]]
            if int(index) == last:
                parts.append(policy[f"log_std_head.{kind}"])
            weights[name] = torch.cat(parts)
        actor.load_state_dict(weights)
        self._load_normalizer(policy)

    def _modules(self) -> dict[str, torch.nn.Module]:
        return {"model": self.agent.model}

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        agent = self.agent
        return {"actor": agent.actor_optimizer, "critic": agent.critic_optimizer, "alpha": agent.log_alpha_optimizer}

    def policy_tensors(self) -> dict[str, Tensor]:
        """Return copies of the policy's weights, by their names in a saved policy."""
        last, tensors = 2 * len(self.spec.hidden), {}
        for name, value in self.agent.model.sac_network.actor.state_dict().items():
            _, index, kind = name.split(".")
            if int(index) == last:  # the means, then the logarithms of the standard deviations
                mean, tensors[f"log_std_head.{kind}"] = (half.clone() for half in value.chunk(2))
                value = mean
            tensors[f"actor.{index}.{kind}"] = value.detach().clone()
        return {**tensors, **self._normalizer_tensors()}

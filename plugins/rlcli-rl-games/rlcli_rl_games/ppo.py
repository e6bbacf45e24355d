"""rl_games' PPO as a trainer."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from rlcli.rl.policy import PolicySpec
from rlcli.rl.trainer import TrainerState
from rlcli_rl_games.base import ACTIVATIONS, OBSERVATION_CLIP, RlGamesTrainer, mean_of
from rlcli_rl_games.config import PpoConfig
from rlcli_rl_games.library import A2CAgent, NullWriter

_DEFAULTS = {"lr_schedule": None, "bounds_loss_coef": 0.0}
"""Keys of `params.config` that rl_games' PPO requires -> value without effect, for settings that lack the key."""


class PpoTrainer(RlGamesTrainer):
    """Trainer for rl_games' PPO."""

    config: PpoConfig

    def _make(self, parameters: dict[str, Any]) -> Any:
        config = self.config.params.config
        size = config.minibatch_size or self.env.num_envs * (config.minibatch_size_per_env or 0)
        central = config.central_value_config
        sizes = {"minibatch_size": size, **({"central_value_config": central.minibatch_size} if central else {})}
        for key, wanted in sizes.items():
            if self.steps_per_iteration % wanted:
                rollout = f"horizon_length x num_envs = {config.horizon_length} x {self.env.num_envs}"
                message = f"a rollout of {rollout} = {self.steps_per_iteration} samples cannot be split into"
                message += f" minibatches of {wanted} samples each"
                raise self._error(key, message, f"give a minibatch size that divides {self.steps_per_iteration}")
        parameters["config"] = {**_DEFAULTS, **parameters["config"]}
        agent = A2CAgent("rlcli", parameters)
        if agent.has_central_value:
            agent.central_value_net.writter = NullWriter()
        if self.bootstrap == "final_obs":
            agent.rewards_shaper = self._bootstrapping(agent, agent.rewards_shaper)
        return agent

    def _bootstrapping(self, agent: Any, shaper: Any) -> Any:
        """Return a reward shaper that calls rl_games' shaper and bootstraps time-outs.

        At a time-out the new shaper adds gamma times the critic's value of the episode's last observation.
        """

        def shape(reward: Tensor) -> Tensor:
            shaped, step = shaper(reward), self.vec.result
            assert step is not None
            if step.final_obs is None:
                return shaped
            value = agent.get_values(self.vec.observe(step.final_obs))
            return shaped + agent.gamma * torch.where(self.vec.timed_out[:, None], value, 0.0)

        return shape

    def _horizon(self) -> int:
        return self.config.params.config.horizon_length

    def _policy_spec(self) -> PolicySpec:
        params = self.config.params
        return PolicySpec(
            observation_size=self.env.layout.size("policy"),
            action_size=self.env.layout.action_size,
            hidden=params.network.mlp.units,
            activation=ACTIVATIONS.get(params.network.mlp.activation, params.network.mlp.activation),  # type: ignore[arg-type]
            action_bound=self.config.action_bound,
            normalize=params.config.normalize_input,
            normalize_clip=OBSERVATION_CLIP,
        )

    def _epoch(self) -> tuple[float, dict[str, float]]:
        agent = self.agent
        agent.update_epoch()
        _, _, update, _, actor, critic, bounds, entropies, divergences, _, _ = agent.train_epoch()
        agent.dataset.update_values_dict(None)
        agent.frame += agent.curr_frames
        losses = {"surrogate": actor, "value": critic, "bounds": bounds, "entropy": entropies, "kl": divergences}
        metrics = {f"Loss/{name}": mean_of(values) for name, values in losses.items() if values}
        metrics["Loss/learning_rate"] = float(agent.last_lr)
        metrics["Policy/mean_std"] = float(agent.model.a2c_network.sigma.detach().exp().mean())
        return update, metrics

    def state(self) -> TrainerState:
        """Return a copy of everything that the next iteration depends on."""
        state = super().state()
        state.values["learning_rate"] = float(self.agent.last_lr)
        if self.agent.has_central_value:
            central = self.agent.central_value_net
            state.values["central"] = {"lr": float(central.lr), "epoch_num": central.epoch_num, "frame": central.frame}
        return state

    def load(self, state: TrainerState) -> None:
        """Restore a saved state. On a CPU the next iteration is bit-identical to the one that followed the save."""
        super().load(state)
        self.agent.last_lr = state.values["learning_rate"]
        self.agent.update_lr(self.agent.last_lr)
        if self.agent.has_central_value:
            for name in ("lr", "epoch_num", "frame"):
                setattr(self.agent.central_value_net, name, state.values["central"][name])
            self.agent.central_value_net.update_lr(self.agent.central_value_net.lr)

    def load_weights(self, policy: Mapping[str, Tensor]) -> None:
        """Load a policy's weights, with its normaliser; the critic's weights do not change.

        If actor and critic share a network, only the critic's output layer does not change.
        """
        network = self.agent.model.a2c_network
        weights = network.state_dict()
        weights |= {theirs: policy[ours].clone() for theirs, ours in self._names().items()}
        network.load_state_dict({**weights, "sigma": policy["log_std"].clone()})
        self._load_normalizer(policy)

    def _modules(self) -> dict[str, torch.nn.Module]:
        modules = {"model": self.agent.model}
        return {**modules, "central": self.agent.central_value_net} if self.agent.has_central_value else modules

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        optimizers = {"policy": self.agent.optimizer}
        if self.agent.has_central_value:
            optimizers["central"] = self.agent.central_value_net.optimizer
        return optimizers

    def _names(self) -> dict[str, str]:
        """Return rl_games' name of each weight of the actor -> its name in a saved policy."""
        last = 2 * len(self.spec.hidden)
        names = {f"mu.{kind}": f"actor.{last}.{kind}" for kind in ("weight", "bias")}
        for name in self.agent.model.a2c_network.state_dict():
            if name.startswith("actor_mlp."):
                names[name] = f"actor.{name.removeprefix('actor_mlp.')}"
        return names

    def policy_tensors(self) -> dict[str, Tensor]:
        """Return copies of the policy's weights, by their names in a saved policy."""
        weights = self.agent.model.a2c_network.state_dict()
        tensors = {ours: weights[theirs].detach().clone() for theirs, ours in self._names().items()}
        return {**tensors, "log_std": weights["sigma"].detach().clone(), **self._normalizer_tensors()}

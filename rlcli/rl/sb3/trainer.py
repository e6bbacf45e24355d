"""Trainer that calls an algorithm of Stable-Baselines3 (SB3) for one iteration at a time.

The trainer saves and restores the whole state of the algorithm, so that a run can be resumed exactly.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.logger import Logger
from torch import Tensor

from rlcli.envs.environment_protocol import Environment
from rlcli.errors import DivergedError
from rlcli.random import derive
from rlcli.rl.budget import remaining_budget
from rlcli.rl.nan_check import LEARNER_HINT, GradientWatch, moments, require_finite, require_finite_learner
from rlcli.rl.optimizers import load_optimizer, optimizer_tensors, tensors_with_prefix
from rlcli.rl.policy import Normalizer
from rlcli.rl.rng import load_rng_state, rng_state
from rlcli.rl.sb3.config import OffPolicyConfig, OnPolicyConfig, Sb3Config
from rlcli.rl.sb3.setup import make_model, policy_spec
from rlcli.rl.trainer import Report, TrainerState
from rlcli.rl.trainer_base import BaseTrainer, finite_values
from rlcli.sim.saved_tensors import require_matching_tensors
from rlcli.sim.state_cache import is_finite

_METRICS = {
    "train/policy_gradient_loss": "Loss/surrogate",
    "train/policy_loss": "Loss/surrogate",
    "train/value_loss": "Loss/value",
    "train/entropy_loss": "Loss/entropy",
    "train/approx_kl": "Loss/kl",
    "train/clip_fraction": "Loss/clip_fraction",
    "train/explained_variance": "Loss/explained_variance",
    "train/std": "Policy/mean_std",
    "train/actor_loss": "Loss/actor",
    "train/critic_loss": "Loss/critic",
    "train/ent_coef": "Loss/entropy_coefficient",
}
"""Name of a metric in SB3's logger -> name of the metric in rlcli."""
_MUST_BE_FINITE = ("Loss/surrogate", "Loss/value", "Loss/actor", "Loss/critic", "Policy/mean_std")
_LR_RANGE = (1e-5, 1e-2)
"""Lowest and highest learning rate of the adaptive schedule."""


class Sb3Trainer(BaseTrainer):
    """SB3 trainer that does one iteration at a time, so that a run can be saved and resumed between two iterations.

    Args:
        env: the environment.
        config: configuration of the agent.
        seed: seed of the initial weights and of exploration.
        device: device of the networks, always `cpu`.
        torch_threads: threads of torch in the update; see `BaseTrainer`.
    """

    def __init__(self, env: Environment, config: Sb3Config, *, seed: int, device: str, torch_threads: int) -> None:
        super().__init__(env, torch_threads)
        self.config = config
        self.iteration = 0
        self.spec = policy_spec(env, config)
        torch.set_num_threads(torch_threads)
        self.model: Any = make_model(env, config, derive(seed, "trainer"), device)
        self.model.set_logger(Logger(folder=None, output_formats=[]))
        self.model._current_progress_remaining = 1.0
        self._learning_rate: float = config.learning_rate
        # SB3's update sets the learning rate of its optimisers to this value
        self.model.lr_schedule = lambda _: self._learning_rate
        self.model.source, self.model.statistics = env, self.statistics
        self.model.reward_scale, self.model.action_bound = config.reward_scale, config.action_bound
        self.normalizer = Normalizer(self.spec.observation_size) if config.normalize_observations else None
        self.model.normalizer = self.normalizer
        self._actor_names = actor_names(config, self.model.policy.state_dict())
        self._is_off_policy = isinstance(config, OffPolicyConfig)
        self._horizon: int = getattr(config, "train_freq" if self._is_off_policy else "n_steps")
        if self._is_off_policy:
            self.model.replay_buffer.normalizer = self.normalizer
        self.steps_per_iteration = self._horizon * env.num_envs
        self._gradients = GradientWatch(self.model.policy, self._optimizers().values())

    @property
    def env_steps(self) -> int:
        """Environment steps taken, over all environments."""
        return int(self.model.num_timesteps)

    def start(self) -> None:
        """Reset the environment to its first episodes."""
        obs = self.env.reset(seed=self.env.seed)["policy"]
        self.model._last_obs = obs.numpy()
        self.model._last_episode_starts = np.ones(self.env.num_envs, dtype=bool)
        self.keep_recent_obs(obs)

    def iterate(self) -> Report:
        """Collect experience, update the networks, and return metrics and durations.

        Raises:
            DivergedError: if a tensor is not finite, with the first such tensor.
        """
        try:
            return self._iterate()
        except ValueError as error:
            if not str(error).startswith("Expected parameter"):  # torch's message for a distribution with NaN
                raise
            self._require_finite_learner()
            message = f"the policy's distribution is not finite in iteration {self.iteration}"
            raise DivergedError(message, hint=LEARNER_HINT) from error

    def _iterate(self) -> Report:
        """Do one iteration; torch raises ValueError for a distribution with NaN."""
        before, begin = dict(self.env.seconds), time.perf_counter()
        torch.set_num_threads(1)
        try:
            if self._is_off_policy:
                self.model.collect(self._horizon)
            else:
                self.model.collect_rollouts(self.model.env, None, self.model.rollout_buffer, self._horizon)
        except (DivergedError, ValueError):
            # if the policy caused the divergence, name its first tensor that is not finite instead
            require_finite(self._rollout_dependencies(), self.iteration + 1)
            raise
        self.keep_recent_obs(torch.as_tensor(self.model._last_obs))
        collected = time.perf_counter()
        torch.set_num_threads(self.torch_threads)
        if self.config.schedule == "linear":
            self._learning_rate = self.config.learning_rate * remaining_budget(self.config, self)
        self.iteration += 1
        self._require_finite_rollout()
        if not isinstance(self.config, OffPolicyConfig):
            self.model.train()
        elif self.env_steps > self.config.learning_starts:
            self.model.train(self.config.gradient_steps, self.config.batch_size)
        updated = time.perf_counter()
        metrics = self._losses()
        self._adapt_learning_rate(metrics.get("Loss/kl"))
        return self.make_report(metrics, self.split_seconds(before, collected - begin, updated - collected))

    def state(self) -> TrainerState:
        """Return a copy of everything that the next iteration depends on."""
        weights = self.model.policy.state_dict()
        rest = {f"weights.{name}": value.clone() for name, value in weights.items() if name not in self._actor_names}
        rest["observations"] = self.recent_obs.clone()
        for name, optimizer in self._optimizers().items():
            rest |= optimizer_tensors(optimizer, f"optimizer.{name}.")
        if getattr(self.model, "log_ent_coef", None) is not None:
            rest["log_ent_coef"] = self.model.log_ent_coef.detach().clone()
        tensors = {
            "policy": self.policy_tensors(),
            "trainer": rest,
            "env": {**self.env.state_dict(), "episode_starts": torch.tensor(self.model._last_episode_starts)},
            "rng": rng_state(),
        }
        logs = {"replay": self.model.replay_buffer.rows(self._horizon)} if self._is_off_policy else {}
        values = {
            "policy": self.spec.model_dump(),
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "learning_rate": self._learning_rate,
            "updates": self.model._n_updates,
            "statistics": self.statistics.state(),
        }
        return TrainerState(tensors, values, logs)

    def load(self, state: TrainerState) -> None:
        """Restore a saved state. On a CPU the next iteration is bit-identical to the one that followed the save."""
        values, rest = state.values, state.tensors["trainer"]
        weights = {f"weights.{name}": value for name, value in self.model.policy.state_dict().items()}
        require_matching_tensors(rest, weights, "trainer")
        starts = torch.ones(self.env.num_envs, dtype=torch.bool)
        require_matching_tensors(state.tensors["env"], {"episode_starts": starts}, "env")
        self.load_weights(state.tensors["policy"], rest)
        for name, optimizer in self._optimizers().items():
            load_optimizer(optimizer, rest, f"optimizer.{name}.")
        if "log_ent_coef" in rest:
            self.model.log_ent_coef.data.copy_(rest["log_ent_coef"])
        self.recent_obs = rest.get("observations", self.recent_obs)
        if "replay" in state.logs:
            self.model.replay_buffer.load_rows(state.logs["replay"])
        self.iteration, self.model.num_timesteps = values["iteration"], values["env_steps"]
        self.model._n_updates = values["updates"]
        self._learning_rate = values["learning_rate"]
        self.statistics.load(values["statistics"])
        self.model._last_episode_starts = state.tensors["env"]["episode_starts"].numpy()
        self.model._last_obs = self.env.load_state_dict(state.tensors["env"])["policy"].numpy()
        load_rng_state(state.tensors["rng"])

    def policy_tensors(self) -> dict[str, Tensor]:
        """Return copies of the policy's weights, by their names in a saved policy."""
        weights = self.model.policy.state_dict()
        tensors = {name: weights[key].clone() for key, name in self._actor_names.items()}
        if self.normalizer is not None:
            tensors.update({f"normalizer.{k}": v.clone() for k, v in self.normalizer.state_dict().items()})
        return tensors

    def load_weights(self, policy: Mapping[str, Tensor], rest: Mapping[str, Tensor] | None = None) -> None:
        """Load the weights and the normaliser of a policy.

        Args:
            policy: the tensors of a saved policy.
            rest: all other weights, from a checkpoint. None: the critics do not change, and the target actor becomes a
                copy of the loaded actor.
        """
        weights = self.model.policy.state_dict()
        if rest is not None:
            weights |= {name: rest[f"weights.{name}"] for name in weights if name not in self._actor_names}
        weights |= {name: policy[own] for name, own in self._actor_names.items()}
        self.model.policy.load_state_dict(weights)
        if rest is None and hasattr(self.model, "actor_target"):
            self.model.actor_target.load_state_dict(self.model.actor.state_dict())
        if self.normalizer is not None:
            self.normalizer.load_state_dict(tensors_with_prefix(policy, "normalizer."))

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        if isinstance(self.config, OnPolicyConfig):
            return {"policy": self.model.policy.optimizer}
        optimizers = {"actor": self.model.actor.optimizer, "critic": self.model.critic.optimizer}
        if getattr(self.model, "ent_coef_optimizer", None) is not None:
            optimizers["ent_coef"] = self.model.ent_coef_optimizer
        return optimizers

    def _recorded_metrics(self) -> dict[str, float]:
        """Return the metrics that SB3 has recorded, with the names of rlcli."""
        recorded = self.model.logger.name_to_value
        return {name: float(recorded[key]) for key, name in _METRICS.items() if key in recorded}

    def _losses(self) -> dict[str, float]:
        """Check the learner and return the finite metrics of the update."""
        self._require_finite_learner()
        metrics = {**self._recorded_metrics(), "Loss/learning_rate": self._learning_rate}
        self.model.logger.name_to_value.clear()
        return finite_values(metrics)

    def _require_finite_rollout(self) -> None:
        """Check the rollout before the update; the environment has already checked the samples of a replay buffer."""
        if not self._is_off_policy:
            buffer = self.model.rollout_buffer
            in_causal_order = [
                ("the normalised observation", buffer.obs),
                ("the action", buffer.action),
                ("the action's log-probability", buffer.log_prob),
                ("the value", buffer.value),
                ("the reward with the bootstrap of time-outs", buffer.reward),
                ("the advantage", buffer.advantage),
                ("the value's target", buffer.target),
            ]
            if not all(is_finite(values) for _, values in in_causal_order):
                require_finite(self._rollout_dependencies(), self.iteration)
                require_finite(in_causal_order, self.iteration, ("step", "environment"))
        require_finite(moments([("observation", self.normalizer)]), self.iteration)

    def _require_finite_learner(self) -> None:
        """Check weights, losses and gradients after an update.

        `GradientWatch` does not let a gradient that is not finite change the weights.
        """
        require_finite(self._weights(), self.iteration)
        metrics = self._recorded_metrics()
        required = {name: metrics[name] for name in _MUST_BE_FINITE if name in metrics}
        required["the loss"] = self.model.logger.name_to_value.get("train/loss", 0.0)
        require_finite_learner(required, {}, self.iteration)
        if self._gradients.first is not None:
            raise DivergedError(
                f"the gradient of '{self._gradients.first}' is not finite, in iteration {self.iteration};"
                " the losses are finite",
                hint=LEARNER_HINT,
            )

    def _rollout_dependencies(self) -> list[tuple[str, Tensor]]:
        """Return the tensors that a rollout depends on, by name: normaliser and weights."""
        return [*moments([("observation", self.normalizer)]), *self._weights()]

    def _weights(self) -> list[tuple[str, Tensor]]:
        weights = [(f"weight '{name}'", value.detach()) for name, value in self.model.policy.named_parameters()]
        entropy = getattr(self.model, "log_ent_coef", None)
        return weights if entropy is None else [*weights, ("the entropy coefficient", entropy.detach())]

    def _adapt_learning_rate(self, kl: float | None) -> None:
        """Adapt the learning rate to the KL divergence; for the rule see `rlcli.rl.ppo.loss.adapt_learning_rate_`."""
        desired = getattr(self.config, "desired_kl", None)
        if desired is None or kl is None:
            return
        low, high = _LR_RANGE
        if kl > 2.0 * desired:
            self._learning_rate = max(low, self._learning_rate / 1.5)
        elif 0.0 < kl < 0.5 * desired:
            self._learning_rate = min(high, self._learning_rate * 1.5)


def actor_names(config: Sb3Config, weights: Iterable[str]) -> dict[str, str]:
    """Return SB3's name of each weight of the actor -> its name in a saved policy.

    `weights` are the names of all weights of SB3's policy.
    """
    output = f"actor.{2 * len(config.policy.hidden)}."  # each hidden layer is followed by an activation
    prefixes = {
        "sac": {"actor.latent_pi.": "actor.", "actor.mu.": output, "actor.log_std.": "log_std_head."},
        "td3": {"actor.mu.": "actor."},
        "ddpg": {"actor.mu.": "actor."},
    }.get(config.algorithm, {"mlp_extractor.policy_net.": "actor.", "action_net.": output, "log_std": "log_std"})
    return {
        name: saved + name.removeprefix(prefix)
        for name in weights
        for prefix, saved in prefixes.items()
        if name.startswith(prefix)
    }

"""The Stable-Baselines3 trainer: SB3's own updates, one iteration at a time, saved and restored exactly."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.logger import Logger
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.errors import DivergedError
from rlcli.random import derive
from rlcli.rl.budget import Budget
from rlcli.rl.nan_check import LEARNER_HINT, GradientWatch, moments, require_finite
from rlcli.rl.optimizers import below, load_optimizer, optimizer_tensors
from rlcli.rl.policy import Normalizer
from rlcli.rl.rng import load_rng_state, rng_state
from rlcli.rl.sb3.config import OffPolicyConfig, OnPolicyConfig, Sb3Config
from rlcli.rl.sb3.setup import make_model, policy_spec
from rlcli.rl.trainer import Report, TrainerState
from rlcli.rl.trainer_base import BaseTrainer, finite_values
from rlcli.sim.state_cache import is_finite
from rlcli.sim.tensor_state import require_matching_tensors

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
_MUST_BE_FINITE = ("Loss/surrogate", "Loss/value", "Loss/actor", "Loss/critic", "Policy/mean_std")
_LR_RANGE = (1e-5, 1e-2)


class Sb3Trainer(BaseTrainer):
    """SB3, one iteration at a time, so that a run can stop, save and resume between any two.

    Args:
        env: the environment.
        config: the agent.
        seed: of the networks and of exploration.
        device: cpu.
        torch_threads: threads of the update; the rollout runs torch on one thread, since two thread pools compete.
    """

    def __init__(self, env: VecEnv, config: Sb3Config, *, seed: int, device: str, torch_threads: int) -> None:
        super().__init__(env, torch_threads)
        self.config = config
        self.iteration = 0
        self.spec = policy_spec(env, config)
        torch.set_num_threads(torch_threads)
        self.model: Any = make_model(env, config, derive(seed, "trainer"), device)
        self.model.set_logger(Logger(folder=None, output_formats=[]))
        self.model._current_progress_remaining = 1.0
        self.model.source, self.model.statistics = env, self.statistics
        self.model.reward_scale, self.model.action_bound = config.reward_scale, config.action_bound
        self.normalizer = Normalizer(self.spec.observation_size) if config.normalize_observations else None
        self.model.normalizer = self.normalizer
        self._actor_names = actor_names(config.algorithm, self.model.policy.state_dict())
        if isinstance(config, OffPolicyConfig):
            self.model.replay_buffer.normalizer = self.normalizer
            self._horizon = config.train_freq
        else:
            assert isinstance(config, OnPolicyConfig)
            self._horizon = config.n_steps
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
        self._keep_recent_obs(obs)

    def iterate(self) -> Report:
        """Collect experience, then update."""
        try:
            return self._iterate()
        except ValueError as error:
            if not str(error).startswith("Expected parameter"):  # how torch refuses a distribution of NaNs
                raise
            self._require_finite_learner()
            raise DivergedError(
                f"the policy's distribution is not finite in iteration {self.iteration}", hint=LEARNER_HINT
            ) from error

    def _iterate(self) -> Report:
        before, begin = dict(self.env.seconds), time.perf_counter()
        torch.set_num_threads(1)
        try:
            self._collect()
        except (DivergedError, ValueError):
            require_finite(self._rollout_dependencies(), self.iteration + 1)
            raise
        self._keep_recent_obs(torch.as_tensor(self.model._last_obs))
        collected = time.perf_counter()
        torch.set_num_threads(self.torch_threads)
        self._decay_learning_rate()
        self.iteration += 1
        self._require_finite_rollout()
        self._update()
        updated = time.perf_counter()
        metrics = self._losses()
        self._adapt_learning_rate(metrics.get("Loss/kl"))
        return self._report(metrics, self._split_seconds(before, collected - begin, updated - collected))

    def state(self) -> TrainerState:
        """Return a copy of everything that the next iteration depends on."""
        weights = self.model.policy.state_dict()
        rest = {f"weights.{name}": value.clone() for name, value in weights.items() if name not in self._actor_names}
        rest["observations"] = self._recent_obs.clone()
        for name, optimizer in self._optimizers().items():
            rest |= optimizer_tensors(optimizer, f"optimizer.{name}.")
        if getattr(self.model, "log_ent_coef", None) is not None:
            rest["log_ent_coef"] = self.model.log_ent_coef.detach().clone()
        tensors = {
            "policy": self._policy_tensors(),
            "trainer": rest,
            "env": {**self.env.state_dict(), "episode_starts": torch.tensor(self.model._last_episode_starts)},
            "rng": rng_state(),
        }
        logs = {}
        if isinstance(self.config, OffPolicyConfig):
            logs["replay"] = self.model.replay_buffer.rows(self._horizon)
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
        """Restore a state: the next iteration gives the same bits as it did then."""
        values, rest = state.values, state.tensors["trainer"]
        weights = {f"weights.{name}": value for name, value in self.model.policy.state_dict().items()}
        require_matching_tensors(rest, weights, "trainer")
        require_matching_tensors(
            state.tensors["env"], {"episode_starts": torch.ones(self.env.num_envs, dtype=torch.bool)}, "env"
        )
        self._load_weights(state.tensors["policy"], rest)
        for name, optimizer in self._optimizers().items():
            load_optimizer(optimizer, rest, f"optimizer.{name}.")
        if "log_ent_coef" in rest:
            self.model.log_ent_coef.data.copy_(rest["log_ent_coef"])
        self._recent_obs = rest.get("observations", self._recent_obs)
        if "replay" in state.logs:
            self.model.replay_buffer.load_rows(state.logs["replay"])
        self.iteration, self.model.num_timesteps = values["iteration"], values["env_steps"]
        self.model._n_updates = values["updates"]
        self._set_learning_rate(values["learning_rate"])
        self.statistics.load(values["statistics"])
        self.model._last_episode_starts = state.tensors["env"]["episode_starts"].numpy()
        self.model._last_obs = self.env.load_state_dict(state.tensors["env"])["policy"].numpy()
        load_rng_state(state.tensors["rng"])

    def load_weights(self, policy: Mapping[str, Tensor]) -> None:
        """Load a policy's weights, with its normaliser; the critics keep their own."""
        self._load_weights(policy, {})

    def _collect(self) -> None:
        if isinstance(self.config, OffPolicyConfig):
            self.model.collect(self._horizon)
        else:
            self.model.collect_rollouts(self.model.env, None, self.model.rollout_buffer, self._horizon)

    def _update(self) -> None:
        if not isinstance(self.config, OffPolicyConfig):
            self.model.train()
        elif self.env_steps > self.config.learning_starts:
            self.model.train(self.config.gradient_steps, self.config.batch_size)

    def _policy_tensors(self) -> dict[str, Tensor]:
        weights = self.model.policy.state_dict()
        tensors = {name: weights[key].clone() for key, name in self._actor_names.items()}
        if self.normalizer is not None:
            tensors.update({f"normalizer.{k}": v.clone() for k, v in self.normalizer.state_dict().items()})
        return tensors

    def _load_weights(self, policy: Mapping[str, Tensor], rest: Mapping[str, Tensor]) -> None:
        weights = self.model.policy.state_dict()
        for name in weights:
            if name in self._actor_names:
                weights[name] = policy[self._actor_names[name]]
            elif rest:
                weights[name] = rest[f"weights.{name}"]
        self.model.policy.load_state_dict(weights)
        if not rest and hasattr(self.model, "actor_target"):
            self.model.actor_target.load_state_dict(self.model.actor.state_dict())
        if self.normalizer is not None:
            self.normalizer.load_state_dict(below(policy, "normalizer."))

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        if isinstance(self.config, OnPolicyConfig):
            return {"policy": self.model.policy.optimizer}
        optimizers = {"actor": self.model.actor.optimizer, "critic": self.model.critic.optimizer}
        if getattr(self.model, "ent_coef_optimizer", None) is not None:
            optimizers["ent_coef"] = self.model.ent_coef_optimizer
        return optimizers

    def _losses(self) -> dict[str, float]:
        recorded = self.model.logger.name_to_value
        metrics = {name: float(recorded[key]) for key, name in _METRICS.items() if key in recorded}
        metrics["Loss/learning_rate"] = self._learning_rate
        self._require_finite_learner()
        recorded.clear()
        return finite_values(metrics)

    def _require_finite_rollout(self) -> None:
        """Check the rollout before the update; a replay buffer holds samples that the environment has checked."""
        if isinstance(self.config, OffPolicyConfig):
            require_finite(moments([("observation", self.normalizer)]), self.iteration)
            return
        buffer = self.model.rollout_buffer
        in_order = [
            ("the observation, as the policy sees it,", buffer.obs),
            ("the action", buffer.action),
            ("the action's log-probability", buffer.log_prob),
            ("the value", buffer.value),
            ("the reward, with the value of what time cut off,", buffer.reward),
            ("the advantage", buffer.advantage),
            ("the value's target", buffer.target),
        ]
        if not all(is_finite(values) for _, values in in_order):
            require_finite(self._rollout_dependencies(), self.iteration)
            require_finite(in_order, self.iteration, ("step", "environment"))
        require_finite(moments([("observation", self.normalizer)]), self.iteration)

    def _require_finite_learner(self) -> None:
        """Check the learner after an update. `GradientWatch` keeps gradients that are not finite from the weights."""
        require_finite(self._weights(), self.iteration)
        recorded = self.model.logger.name_to_value
        metrics = {name: float(recorded[key]) for key, name in _METRICS.items() if key in recorded}
        for name in _MUST_BE_FINITE:
            if not math.isfinite(metrics.get(name, 0.0)):
                raise DivergedError(f"{name} is not finite in iteration {self.iteration}", hint=LEARNER_HINT)
        if not math.isfinite(recorded.get("train/loss", 0.0)):
            raise DivergedError(f"the loss is not finite in iteration {self.iteration}", hint=LEARNER_HINT)
        if self._gradients.first is not None:
            raise DivergedError(
                f"the gradient of '{self._gradients.first}' is not finite, in iteration {self.iteration};"
                " the losses are",
                hint=LEARNER_HINT,
            )

    def _rollout_dependencies(self) -> list[tuple[str, Tensor]]:
        """Return the named tensors that a rollout depends on."""
        return [*moments([("observation", self.normalizer)]), *self._weights()]

    def _weights(self) -> list[tuple[str, Tensor]]:
        weights = [(f"weight '{name}'", value.detach()) for name, value in self.model.policy.named_parameters()]
        entropy = getattr(self.model, "log_ent_coef", None)
        return weights if entropy is None else [*weights, ("the entropy coefficient", entropy.detach())]

    def _decay_learning_rate(self) -> None:
        if self.config.schedule == "linear":
            done = Budget(self.config.max_iterations, self.config.max_steps).share(self)
            self._set_learning_rate(self.config.learning_rate * max(0.0, 1.0 - done))

    def _adapt_learning_rate(self, kl: float | None) -> None:
        desired = getattr(self.config, "desired_kl", None)
        if desired is None or kl is None:
            return
        low, high = _LR_RANGE
        if kl > 2.0 * desired:
            self._set_learning_rate(max(low, self._learning_rate / 1.5))
        elif 0.0 < kl < 0.5 * desired:
            self._set_learning_rate(min(high, self._learning_rate * 1.5))

    @property
    def _learning_rate(self) -> float:
        return float(self.model.lr_schedule(1.0))

    def _set_learning_rate(self, value: float) -> None:
        self.model.lr_schedule = lambda _: value


def actor_names(algorithm: str, weights: Mapping[str, Tensor]) -> dict[str, str]:
    """Map SB3's names of the actor's weights to those of a saved policy, the output layer after the hidden ones."""
    hidden, output = {
        "sac": ("actor.latent_pi.", "actor.mu."),
        "td3": ("actor.mu.", None),
        "ddpg": ("actor.mu.", None),
    }.get(algorithm, ("mlp_extractor.policy_net.", "action_net."))
    layers = sum(name.startswith(hidden) and name.endswith(".weight") for name in weights)
    names = {}
    for name in weights:
        if name == "log_std":
            names[name] = name
        elif name.startswith(hidden):
            names[name] = f"actor.{name.removeprefix(hidden)}"
        elif output is not None and name.startswith(output):
            names[name] = f"actor.{2 * layers}.{name.removeprefix(output)}"
        elif name.startswith("actor.log_std."):
            names[name] = f"log_std_head.{name.removeprefix('actor.log_std.')}"
    return names

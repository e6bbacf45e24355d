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

from rlcli.adapters.sb3 import Sb3VecEnv
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import ConfigError, DivergedError
from rlcli.random import derive
from rlcli.rl.finite import LEARNER_HINT, GradientWatch, moments, require_finite
from rlcli.rl.optimizers import Adam, below, load_optimizer, optimizer_tensors
from rlcli.rl.policy import ACTIVATIONS, Normalizer, Policy, PolicySpec
from rlcli.rl.rng import load_rng_state, rng_state
from rlcli.rl.sb3_algorithms import FastA2C, FastDDPG, FastPPO, FastSAC, FastTD3
from rlcli.rl.sb3_buffers import TorchReplayBuffer, TorchRolloutBuffer
from rlcli.rl.sb3_config import (
    A2cConfig,
    DdpgConfig,
    OffPolicyConfig,
    OnPolicyConfig,
    PpoConfig,
    SacConfig,
    Sb3Config,
    Td3Config,
)
from rlcli.rl.statistics import EpisodeStatistics
from rlcli.rl.train import Budget
from rlcli.rl.trainer import Report, TrainerState
from rlcli.sim.saved import require_alike
from rlcli.sim.state import is_finite

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
_RECORDED = 256
"""Recent observations that a checkpoint keeps, for checking what is made of the policy later."""


class Sb3Trainer:
    """Drives SB3 one iteration at a time, so that a run can stop, save and resume at any boundary.

    Args:
        env: the environment.
        config: the agent.
        seed: of the networks and of exploration.
        device: cpu.
        torch_threads: threads of the update; the rollout runs torch on one, because two thread pools fight.
    """

    def __init__(self, env: VecEnv, config: Sb3Config, *, seed: int, device: str, torch_threads: int) -> None:
        self.env = env
        self.config = config
        self.torch_threads = torch_threads
        self.iteration = 0
        env.final_obs_of = "truncated"
        self.statistics = EpisodeStatistics(env.config.episode_length_s)
        self.spec = policy_spec(env, config)
        torch.set_num_threads(torch_threads)
        self.model: Any = _make(env, config, derive(seed, "trainer"), device)
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
        self._recorded = torch.zeros(0, self.spec.observation_size)
        self._gradients = GradientWatch(self.model.policy, self._optimizers().values())

    @property
    def env_steps(self) -> int:
        """Environment steps taken."""
        return self.model.num_timesteps

    def start(self) -> None:
        """Reset the environment to its first episodes."""
        obs = self.env.reset(seed=self.env.seed)["policy"]
        self.model._last_obs = obs.numpy()
        self.model._last_episode_starts = np.ones(self.env.num_envs, dtype=bool)
        self._record()

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
        physics, step = self.env.seconds["physics"], self.env.seconds["step"]
        begin = time.perf_counter()
        torch.set_num_threads(1)
        try:
            self._collect()
        except (DivergedError, ValueError):  # where the action comes from, it may have gone wrong
            require_finite(self._learned(), self.iteration + 1)
            raise
        self._record()
        collected = time.perf_counter()
        torch.set_num_threads(self.torch_threads)
        self._decay()
        self.iteration += 1
        self._require_finite_rollout()
        self._update()
        updated = time.perf_counter()
        metrics = self._losses()
        self._adapt(metrics.get("Loss/kl"))
        physics, step = self.env.seconds["physics"] - physics, self.env.seconds["step"] - step
        seconds = {
            "physics": physics,
            "task": step - physics,
            "policy": collected - begin - step,
            "update": updated - collected,
        }
        task = {name: value for name, value in self.env.extras().items() if math.isfinite(value)}
        return Report({**self.statistics.flush(), **task, **metrics}, seconds)

    def policy(self) -> Policy:
        """The deployable policy as it is now, with weights of its own."""
        policy = Policy(self.spec)
        policy.load_state_dict(self._policy_tensors())
        return policy.eval().requires_grad_(False)

    def state(self) -> TrainerState:
        """A copy of everything that the next iteration depends on."""
        weights = self.model.policy.state_dict()
        rest = {f"weights.{name}": value.clone() for name, value in weights.items() if name not in self._actor_names}
        rest["observations"] = self._recorded.clone()
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
        """Go back to a boundary: the next iteration gives the same bits as it did then."""
        values, rest = state.values, state.tensors["trainer"]
        weights = {f"weights.{name}": value for name, value in self.model.policy.state_dict().items()}
        require_alike(rest, weights, "trainer")
        require_alike(state.tensors["env"], {"episode_starts": torch.ones(self.env.num_envs, dtype=torch.bool)}, "env")
        self._load_weights(state.tensors["policy"], rest)
        for name, optimizer in self._optimizers().items():
            load_optimizer(optimizer, rest, f"optimizer.{name}.")
        if "log_ent_coef" in rest:
            self.model.log_ent_coef.data.copy_(rest["log_ent_coef"])
        self._recorded = rest.get("observations", self._recorded)
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
        """Take a policy's weights, with its normaliser; critics stay as they are."""
        self._load_weights(policy, {})

    def _collect(self) -> None:
        if isinstance(self.config, OffPolicyConfig):
            self.model.collect(self._horizon)
        else:
            self.model.collect_rollouts(self.model.env, None, self.model.rollout_buffer, self._horizon)

    def _record(self) -> None:
        newest = torch.as_tensor(self.model._last_obs)[:_RECORDED]
        self._recorded = torch.cat([newest, self._recorded])[:_RECORDED]

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
        return {name: value for name, value in metrics.items() if math.isfinite(value)}

    def _require_finite_rollout(self) -> None:
        """Before anything is learned from it; a replay buffer holds what the environment has checked."""
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
            require_finite(self._learned(), self.iteration)
            require_finite(in_order, self.iteration, ("step", "environment"))
        require_finite(moments([("observation", self.normalizer)]), self.iteration)

    def _require_finite_learner(self) -> None:
        """What an update gives. Gradients that are not finite reach no weight: weights that are not were so before."""
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

    def _learned(self) -> list[tuple[str, Tensor]]:
        """What a rollout is made with."""
        return [*moments([("observation", self.normalizer)]), *self._weights()]

    def _weights(self) -> list[tuple[str, Tensor]]:
        weights = [(f"weight '{name}'", value.detach()) for name, value in self.model.policy.named_parameters()]
        entropy = getattr(self.model, "log_ent_coef", None)
        return weights if entropy is None else [*weights, ("the entropy coefficient", entropy.detach())]

    def _decay(self) -> None:
        if self.config.schedule == "linear":
            done = Budget(self.config.max_iterations, self.config.max_steps).share(self)
            self._set_learning_rate(self.config.learning_rate * max(0.0, 1.0 - done))

    def _adapt(self, kl: float | None) -> None:
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


def policy_spec(env: VecEnv, config: Sb3Config) -> PolicySpec:
    """What the trained policy is made of."""
    kind = {"sac": "squashed-gaussian-mlp", "td3": "deterministic-mlp", "ddpg": "deterministic-mlp"}
    return PolicySpec(
        kind=kind.get(config.algorithm, "gaussian-mlp"),  # type: ignore[arg-type]
        observation_size=env.layout.size("policy"),
        action_size=env.layout.action_size,
        hidden=list(config.policy.hidden),
        activation=config.policy.activation,
        action_bound=config.action_bound,
        normalize=config.normalize_observations,
    )


def _make(env: VecEnv, config: Sb3Config, seed: int, device: str) -> Any:
    common: dict[str, Any] = {
        "policy": "MlpPolicy",
        "env": Sb3VecEnv(env, config.action_bound),
        "learning_rate": config.learning_rate,
        "gamma": config.gamma,
        "seed": seed,
        "device": device,
    }
    # SB3's own Adam, its step in one kernel; A2C keeps its RMSprop
    adam = {"fused": True} if isinstance(config, OffPolicyConfig) else {"fused": True, "eps": 1e-5}
    networks: dict[str, Any] = {
        "activation_fn": ACTIVATIONS[config.policy.activation],
        "optimizer_kwargs": None if isinstance(config, A2cConfig) else adam,
    }
    if not isinstance(config, A2cConfig):
        networks["optimizer_class"] = Adam
    if isinstance(config, OffPolicyConfig):
        return _make_off_policy(config, common, {**networks, "net_arch": list(config.policy.hidden)})
    assert isinstance(config, OnPolicyConfig)
    networks |= {
        "net_arch": {"pi": list(config.policy.hidden), "vf": list(config.policy.hidden)},
        "log_std_init": math.log(config.policy.init_std),
        "ortho_init": config.policy.ortho_init,
    }
    common |= {
        "n_steps": config.n_steps,
        "gae_lambda": config.gae_lambda,
        "normalize_advantage": config.normalize_advantage,
        "ent_coef": config.ent_coef,
        "vf_coef": config.vf_coef,
        "max_grad_norm": config.max_grad_norm,
        "rollout_buffer_class": TorchRolloutBuffer,
        "policy_kwargs": networks,
    }
    total = config.n_steps * env.num_envs
    _require_batch(env, config, total)
    if isinstance(config, A2cConfig):
        return FastA2C(**common)
    assert isinstance(config, PpoConfig)
    model = FastPPO(
        **common,
        batch_size=total,  # the buffer divides it, whatever the number of environments
        n_epochs=config.n_epochs,
        clip_range=config.clip_range,
        clip_range_vf=config.clip_range_vf,
    )
    model.rollout_buffer.num_minibatches = config.num_minibatches
    return model


def _make_off_policy(config: OffPolicyConfig, common: dict[str, Any], networks: dict[str, Any]) -> Any:
    common = {
        **common,
        "policy_kwargs": networks,
        "buffer_size": config.buffer_size,
        "batch_size": config.batch_size,
        "learning_starts": config.learning_starts,
        "tau": config.tau,
        "replay_buffer_class": TorchReplayBuffer,
    }
    if isinstance(config, SacConfig):
        model: Any = FastSAC(**common, ent_coef=config.ent_coef)
        model.exploration_noise = 0.0
        return model
    if isinstance(config, Td3Config):
        model = FastTD3(
            **common,
            policy_delay=config.policy_delay,
            target_policy_noise=config.target_policy_noise,
            target_noise_clip=config.target_noise_clip,
        )
    else:
        model = FastDDPG(**common)
    assert isinstance(config, Td3Config | DdpgConfig)
    model.exploration_noise = config.exploration_noise
    return model


def _require_batch(env: VecEnv, config: OnPolicyConfig, total: int) -> None:
    rollout = f"a rollout holds n_steps x num_envs = {config.n_steps} x {env.num_envs} = {total} samples"
    minibatches = config.num_minibatches if isinstance(config, PpoConfig) else 1
    if total < minibatches:
        key, message = "num_minibatches", f"{minibatches} minibatches cannot be made: {rollout}"
    elif total == 1 and config.normalize_advantage:
        key, message = "n_steps", f"advantages cannot be normalised: {rollout}"
    else:
        return
    path = ("agents", env.resolved.agent_name or "", key)
    raise ConfigError([env.resolved.problem(path, message, "more environments, more n_steps, or fewer minibatches")])


def actor_names(algorithm: str, weights: Mapping[str, Tensor]) -> dict[str, str]:
    """SB3's names of the actor's weights -> the saved policy's, its output layer numbered after the hidden ones."""
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

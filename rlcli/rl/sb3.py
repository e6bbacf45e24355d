"""The Stable-Baselines3 trainer: SB3's own PPO update, on a rollout that stays in torch from end to end."""

from __future__ import annotations

import math
import random
import time
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import RolloutBufferSamples
from stable_baselines3.common.vec_env import VecEnv as Sb3Base
from torch import Tensor

from rlcli.adapters.sb3 import Sb3VecEnv
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import ConfigError, DivergedError
from rlcli.random import derive
from rlcli.rl.policy import _ACTIVATIONS, Policy, PolicySpec
from rlcli.rl.sb3_config import PpoConfig
from rlcli.rl.statistics import EpisodeStatistics
from rlcli.rl.train import Budget
from rlcli.rl.trainer import Report, TrainerState

_LOSSES = {
    "train/policy_gradient_loss": "Loss/surrogate",
    "train/value_loss": "Loss/value",
    "train/entropy_loss": "Loss/entropy",
    "train/approx_kl": "Loss/kl",
    "train/clip_fraction": "Loss/clip_fraction",
    "train/explained_variance": "Loss/explained_variance",
    "train/std": "Policy/mean_std",
}
_LR_RANGE = (1e-5, 1e-2)


class TorchRolloutBuffer(RolloutBuffer):
    """SB3's rollout buffer with torch storage, gathered by `index_select`. All tensors are (n_steps, n_envs, ...)."""

    num_minibatches: int | None = None
    """Parts that `get` makes of the rollout, as even as they can be; None makes parts of its `batch_size`."""

    def reset(self) -> None:
        """Forget the rollout; the storage is made once."""
        if not hasattr(self, "obs"):
            steps, envs = self.buffer_size, self.n_envs
            self.obs = torch.zeros(steps, envs, *self.obs_shape)
            self.action = torch.zeros(steps, envs, self.action_dim)
            self.reward, self.start, self.value, self.log_prob, self.advantage, self.target = (
                torch.zeros(steps, envs) for _ in range(6)
            )
            # SB3's update reads these two, as numpy, for its explained variance
            self.values, self.returns = self.value.numpy(), self.target.numpy()
        self.pos, self.full = 0, False

    def put(self, obs: Tensor, action: Tensor, reward: Tensor, start: Tensor, value: Tensor, log_prob: Tensor) -> None:
        """Store one step of every environment."""
        for storage, values in (
            (self.obs, obs),
            (self.action, action),
            (self.reward, reward),
            (self.start, start),
            (self.value, value),
            (self.log_prob, log_prob),
        ):
            storage[self.pos].copy_(values)
        self.pos += 1
        self.full = self.pos == self.buffer_size

    def finish(self, last_value: Tensor, last_done: Tensor) -> None:
        """Generalised advantage estimation (Schulman et al. 2016), backwards over the rollout."""
        advantage = torch.zeros_like(last_value)
        next_value, alive = last_value, 1.0 - last_done.float()
        for step in reversed(range(self.buffer_size)):
            delta = self.reward[step] + self.gamma * next_value * alive - self.value[step]
            advantage = delta + self.gamma * self.gae_lambda * alive * advantage
            self.advantage[step].copy_(advantage)
            next_value, alive = self.value[step], 1.0 - self.start[step]
        torch.add(self.advantage, self.value, out=self.target)

    def get(self, batch_size: int | None = None) -> Iterator[RolloutBufferSamples]:  # type: ignore[override]
        """Minibatches of a fresh permutation."""
        total = self.buffer_size * self.n_envs
        storage = (self.obs, self.action, self.value, self.log_prob, self.advantage, self.target)
        columns = [tensor.view(total, *tensor.shape[2:]) for tensor in storage]
        rows_of_parts = (
            torch.randperm(total).split(batch_size or total)
            if self.num_minibatches is None
            else torch.randperm(total).tensor_split(self.num_minibatches)
        )
        for rows in rows_of_parts:
            yield RolloutBufferSamples(*(column.index_select(0, rows) for column in columns))


class FastPPO(PPO):
    """SB3's PPO with a rollout that steps the `VecEnv` directly and bootstraps all time-outs of a step at once."""

    rollout_buffer: TorchRolloutBuffer
    source: VecEnv
    statistics: EpisodeStatistics
    reward_scale: float
    clips: bool

    def collect_rollouts(
        self, env: Sb3Base, callback: BaseCallback, rollout_buffer: RolloutBuffer, n_rollout_steps: int
    ) -> bool:
        """Fill the buffer with `n_rollout_steps` of every environment."""
        buffer, source, policy = self.rollout_buffer, self.source, self.policy
        policy.set_training_mode(False)
        buffer.reset()
        obs, start = torch.as_tensor(self._last_obs), torch.as_tensor(self._last_episode_starts)
        low, high = float(self.action_space.low[0]), float(self.action_space.high[0])
        done = start
        with torch.inference_mode():
            for _ in range(n_rollout_steps):
                action, value, log_prob = policy(obs)
                result = source.step(action.clamp(low, high) if self.clips else action)
                reward = result.reward * self.reward_scale
                if result.final_obs is not None:
                    cut = (result.truncated & ~result.terminated).nonzero().squeeze(1)
                    final_value = policy.predict_values(result.final_obs["policy"].index_select(0, cut)).flatten()
                    reward.index_add_(0, cut, final_value, alpha=self.gamma)
                buffer.put(obs, action, reward, start, value.flatten(), log_prob)
                self.statistics.add(result.episodes)
                done = result.terminated | result.truncated
                obs, start = result.obs["policy"], done
            buffer.finish(policy.predict_values(obs).flatten(), done)
        self.num_timesteps += n_rollout_steps * source.num_envs
        self._last_obs = obs.numpy()
        self._last_episode_starts = start.numpy()
        return True


class Sb3Trainer:
    """Drives SB3 one iteration at a time, so that a run can stop, save and resume at any boundary.

    Args:
        env: the environment.
        config: the agent.
        seed: of the networks and of exploration.
        device: cpu.
        torch_threads: threads of the update; the rollout runs torch on one, because two thread pools fight.
    """

    def __init__(self, env: VecEnv, config: PpoConfig, *, seed: int, device: str, torch_threads: int) -> None:
        self.env = env
        self.config = config
        self.torch_threads = torch_threads
        self.iteration = 0
        env.final_obs_of = "truncated"
        self.statistics = EpisodeStatistics(env.config.episode_length_s)
        torch.set_num_threads(torch_threads)
        self.model = _make_ppo(env, config, derive(seed, "trainer"), device)
        self.model.statistics = self.statistics
        self.steps_per_iteration = config.n_steps * env.num_envs

    @property
    def env_steps(self) -> int:
        """Environment steps taken."""
        return self.model.num_timesteps

    def start(self) -> None:
        """Reset the environment to its first episodes."""
        obs = self.env.reset(seed=self.env.seed)["policy"]
        self.model._last_obs = obs.numpy()
        self.model._last_episode_starts = np.ones(self.env.num_envs, dtype=bool)

    def iterate(self) -> Report:
        """Collect one rollout, then update."""
        try:
            return self._iterate()
        except ValueError as error:
            if not str(error).startswith("Expected parameter"):  # how torch refuses a distribution of NaNs
                raise
            self._require_finite_weights()
            raise DivergedError(
                f"the policy's distribution is not finite in iteration {self.iteration}", hint=_LEARNER_HINT
            ) from error

    def _iterate(self) -> Report:
        model = self.model
        physics, step = self.env.seconds["physics"], self.env.seconds["step"]
        begin = time.perf_counter()
        torch.set_num_threads(1)
        model.collect_rollouts(model.env, self._no_callback, model.rollout_buffer, model.n_steps)  # type: ignore[arg-type]
        collected = time.perf_counter()
        torch.set_num_threads(self.torch_threads)
        self._decay()
        self.iteration += 1
        model.train()
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
        return Report({**self.statistics.flush(), **metrics}, seconds)

    def policy(self) -> Policy:
        """The deployable policy, sharing the actor's weights."""
        policy = Policy(policy_spec(self.env, self.config))
        weights = self.model.policy.state_dict()
        policy.load_state_dict({name: weights[key] for key, name in _actor_names(weights).items()})
        return policy.eval().requires_grad_(False)

    def state(self) -> TrainerState:
        """A copy of everything that the next iteration depends on."""
        weights = self.model.policy.state_dict()
        actor = _actor_names(weights)
        rest = {f"critic.{name}": value.clone() for name, value in weights.items() if name not in actor}
        optimizer = self.model.policy.optimizer.state_dict()["state"]
        for index, slots in optimizer.items():
            rest.update({f"optimizer.{index}.{slot}": value.clone() for slot, value in slots.items()})
        return TrainerState(
            tensors={
                "policy": {name: weights[key].clone() for key, name in actor.items()},
                "trainer": rest,
                "env": {
                    **self.env.state_dict(),
                    "episode_starts": torch.as_tensor(self.model._last_episode_starts),
                },
                "rng": rng_state(),
            },
            values={
                "policy": policy_spec(self.env, self.config).model_dump(),
                "iteration": self.iteration,
                "env_steps": self.env_steps,
                "learning_rate": self._learning_rate,
                "updates": self.model._n_updates,
                "statistics": self.statistics.state(),
            },
        )

    def load(self, state: TrainerState) -> None:
        """Go back to a boundary: the next iteration gives the same bits as it did then."""
        values = state.values
        self.load_weights(state.tensors["policy"], critic=state.tensors["trainer"])
        self._load_optimizer(state.tensors["trainer"])
        self.iteration, self.model.num_timesteps = values["iteration"], values["env_steps"]
        self.model._n_updates = values["updates"]
        self._set_learning_rate(values["learning_rate"])
        self.statistics.load(values["statistics"])
        self.model._last_episode_starts = state.tensors["env"]["episode_starts"].numpy()
        self.model._last_obs = self.env.load_state_dict(state.tensors["env"])["policy"].numpy()
        load_rng_state(state.tensors["rng"])

    def load_weights(self, policy: Mapping[str, Tensor], critic: Mapping[str, Tensor] | None = None) -> None:
        """Take a policy's weights, and the critic's where they are given."""
        weights = self.model.policy.state_dict()
        actor = _actor_names(weights)
        for name in weights:
            if name in actor:
                weights[name] = policy[actor[name]]
            elif critic is not None:
                weights[name] = critic[f"critic.{name}"]
        self.model.policy.load_state_dict(weights)

    def _losses(self) -> dict[str, float]:
        recorded = self.model.logger.name_to_value
        metrics = {name: float(recorded[key]) for key, name in _LOSSES.items() if key in recorded}
        metrics["Loss/learning_rate"] = self._learning_rate
        for name in ("Loss/surrogate", "Loss/value", "Policy/mean_std"):
            if not math.isfinite(metrics.get(name, 0.0)):
                raise DivergedError(f"{name} is not finite in iteration {self.iteration}", hint=_LEARNER_HINT)
        self._require_finite_weights()
        recorded.clear()
        return {name: value for name, value in metrics.items() if math.isfinite(value)}

    def _require_finite_weights(self) -> None:
        for name, parameter in self.model.policy.named_parameters():
            if not bool(parameter.isfinite().all()):
                raise DivergedError(f"weight '{name}' is not finite in iteration {self.iteration}", hint=_LEARNER_HINT)

    def _decay(self) -> None:
        if self.config.schedule == "linear":
            done = Budget(self.config.max_iterations, self.config.max_steps).share(self)
            self._set_learning_rate(self.config.learning_rate * max(0.0, 1.0 - done))

    def _adapt(self, kl: float | None) -> None:
        desired = self.config.desired_kl
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

    def _load_optimizer(self, tensors: Mapping[str, Tensor]) -> None:
        state: dict[int, dict[str, Tensor]] = {}
        for name, value in tensors.items():
            if name.startswith("optimizer."):
                _, index, slot = name.split(".")
                state.setdefault(int(index), {})[slot] = value.clone()
        groups = self.model.policy.optimizer.state_dict()["param_groups"]
        self.model.policy.optimizer.load_state_dict({"state": state, "param_groups": groups})

    @property
    def _no_callback(self) -> Any:
        return None


_LEARNER_HINT = "lower learning_rate or max_grad_norm; the last good checkpoint is kept"


def policy_spec(env: VecEnv, config: PpoConfig) -> PolicySpec:
    """What the trained policy is made of."""
    return PolicySpec(
        observation_size=env.layout.size("policy"),
        action_size=env.layout.action_size,
        hidden=list(config.policy.hidden),
        activation=config.policy.activation,
        action_bound=config.action_bound,
    )


def rng_state() -> dict[str, Tensor]:
    """States of the global generators of torch, numpy and Python."""
    kind, keys, position, has_gauss, gauss = np.random.get_state()
    assert kind == "MT19937"
    version, words, next_gauss = random.getstate()
    return {
        "torch": torch.get_rng_state(),
        "numpy.keys": torch.from_numpy(np.asarray(keys).astype(np.int64)),
        "numpy.position": torch.tensor([int(position), int(has_gauss)]),
        "numpy.gauss": torch.tensor([float(gauss)], dtype=torch.float64),
        "python.words": torch.tensor([version, *words], dtype=torch.int64),
        "python.gauss": torch.tensor([math.nan if next_gauss is None else next_gauss], dtype=torch.float64),
    }


def load_rng_state(state: Mapping[str, Tensor]) -> None:
    """Take back what `rng_state` gave."""
    torch.set_rng_state(state["torch"])
    position, has_gauss = state["numpy.position"].tolist()
    keys = state["numpy.keys"].numpy().astype(np.uint32)
    np.random.set_state(("MT19937", keys, position, has_gauss, float(state["numpy.gauss"])))
    version, *words = state["python.words"].tolist()
    gauss = float(state["python.gauss"])
    random.setstate((version, tuple(words), None if math.isnan(gauss) else gauss))


def _make_ppo(env: VecEnv, config: PpoConfig, seed: int, device: str) -> FastPPO:
    total = config.n_steps * env.num_envs
    _require_batch(env, config, total)
    model = FastPPO(
        "MlpPolicy",
        Sb3VecEnv(env, config.action_bound),
        learning_rate=config.learning_rate,
        n_steps=config.n_steps,
        batch_size=total,  # the buffer divides it, whatever the number of environments
        n_epochs=config.n_epochs,
        gamma=config.gamma,
        gae_lambda=config.gae_lambda,
        clip_range=config.clip_range,
        clip_range_vf=config.clip_range_vf,
        normalize_advantage=config.normalize_advantage,
        ent_coef=config.ent_coef,
        vf_coef=config.vf_coef,
        max_grad_norm=config.max_grad_norm,
        rollout_buffer_class=TorchRolloutBuffer,
        policy_kwargs={
            "net_arch": {"pi": list(config.policy.hidden), "vf": list(config.policy.hidden)},
            "activation_fn": _ACTIVATIONS[config.policy.activation],
            "log_std_init": math.log(config.policy.init_std),
            "ortho_init": config.policy.ortho_init,
        },
        seed=seed,
        device=device,
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    model._current_progress_remaining = 1.0
    model.rollout_buffer.num_minibatches = config.num_minibatches
    model.source = env
    model.reward_scale = config.reward_scale
    model.clips = config.action_bound is not None
    return model


def _require_batch(env: VecEnv, config: PpoConfig, total: int) -> None:
    rollout = f"a rollout holds n_steps x num_envs = {config.n_steps} x {env.num_envs} = {total} samples"
    if total < config.num_minibatches:
        key, message = "num_minibatches", f"{config.num_minibatches} minibatches cannot be made: {rollout}"
    elif total == 1 and config.normalize_advantage:
        key, message = "n_steps", f"advantages cannot be normalised: {rollout}"
    else:
        return
    path = ("agents", env.resolved.agent_name or "", key)
    raise ConfigError([env.resolved.problem(path, message, "more environments, more n_steps, or fewer minibatches")])


def _actor_names(weights: Mapping[str, Tensor]) -> dict[str, str]:
    """SB3's names of the actor's weights -> the saved policy's, its output layer numbered after the hidden ones."""
    hidden = "mlp_extractor.policy_net."
    layers = sum(name.startswith(hidden) and name.endswith(".weight") for name in weights)
    names = {}
    for name in weights:
        if name == "log_std":
            names[name] = name
        elif name.startswith(hidden):
            names[name] = f"actor.{name.removeprefix(hidden)}"
        elif name.startswith("action_net."):
            names[name] = f"actor.{2 * layers}.{name.removeprefix('action_net.')}"
    return names

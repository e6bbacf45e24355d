"""rl_games' PPO and SAC, one iteration at a time, saved and restored exactly; nothing is written but by rlcli."""

from __future__ import annotations

import contextlib
import copy
import io
import math
import tempfile
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from importlib import metadata
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rlcli.envs.step import StepResult
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import ConfigError, DependencyError, DivergedError
from rlcli.random import derive
from rlcli.rl.optimizers import below, load_optimizer, optimizer_tensors
from rlcli.rl.policy import Policy, PolicySpec
from rlcli.rl.rng import load_rng_state, rng_state, seed_generators
from rlcli.rl.statistics import EpisodeStatistics
from rlcli.rl.trainer import Report, TrainerState
from rlcli_rl_games.config import PpoConfig, RlGamesConfig, SacConfig

NEEDED = "rl-games>=1.6,<1.7"
try:
    _VERSION = tuple(int(part) for part in metadata.version("rl-games").split(".")[:2])
except metadata.PackageNotFoundError:
    _VERSION = (0, 0)
if _VERSION != (1, 6):
    _found = f"rl-games {'.'.join(map(str, _VERSION))} is" if any(_VERSION) else "rl-games is not"
    raise DependencyError(f"trainer 'rl-games' needs {NEEDED}, and {_found} installed", hint=f"pip install '{NEEDED}'")

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of what rl_games imports
    from rl_games.algos_torch.a2c_continuous import A2CAgent
    from rl_games.algos_torch.sac_agent import SACAgent
    from rl_games.common.algo_observer import AlgoObserver
    from rl_games.common.experience import VectorizedReplayBuffer
    from rl_games.common.gym_compat import gym
    from rl_games.common.ivecenv import IVecEnv
    from rl_games.common.tr_helpers import DefaultRewardsShaper

_RECORDED = 256
"""Recent observations that a checkpoint keeps, for checking what is made of the policy later."""
_ACTIVATIONS = {"swish": "silu"}
_EPSILON = 1e-5
"""What rl_games adds to the variance of observations."""
_OBSERVATION_CLIP = 5.0
"""Where it clips normalised observations."""
_LEARNER_HINT = "lower the learning rate or grad_norm in params.config; the last good checkpoint is kept"


class RlGamesVecEnv(IVecEnv):
    """A `VecEnv` as rl_games wants it.

    Args:
        env: the environment.
        central: whether the observation group `critic` goes along as `states`.
        time_outs: whether rl_games hears of time-outs, and bootstraps in its own way.
        threads: torch's, outside of the environment's step, which runs on one.
    """

    def __init__(self, env: VecEnv, *, central: bool, time_outs: bool, threads: int) -> None:
        self.env, self.central, self.time_outs, self.threads = env, central, time_outs, threads
        self.statistics = EpisodeStatistics(env.config.episode_length_s)
        self.result: StepResult | None = None

    def step(self, actions: Tensor) -> tuple[dict[str, Tensor], Tensor, Tensor, dict[str, Tensor]]:
        """One step of every environment."""
        torch.set_num_threads(1)
        self.result = step = self.env.step(actions)
        torch.set_num_threads(self.threads)
        self.statistics.add(step.episodes)
        infos = {"time_outs": self.cut} if self.time_outs else {}
        return self.observe(step.obs), step.reward, (step.terminated | step.truncated).to(torch.uint8), infos

    def reset(self) -> dict[str, Tensor]:
        """The first observations."""
        return self.observe(self.env.reset(seed=self.env.seed))

    def observe(self, groups: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Observation groups in rl_games' form."""
        return {"obs": groups["policy"], **({"states": groups["critic"]} if self.central else {})}

    @property
    def cut(self) -> Tensor:
        """Which episodes the last step ended by time alone. (num_envs,) bool"""
        assert self.result is not None
        return self.result.truncated & ~self.result.terminated

    def get_env_info(self) -> dict[str, Any]:
        """Spaces."""
        return self.spaces(1.0)

    def spaces(self, bound: float) -> dict[str, Any]:
        """Spaces with actions in +-bound."""

        def box(size: int, limit: float) -> Any:
            return gym.spaces.Box(-limit, limit, (size,), np.float32)

        layout = self.env.layout
        info = {"observation_space": box(layout.size("policy"), np.inf), "action_space": box(layout.action_size, bound)}
        return {**info, "state_space": box(layout.size("critic"), np.inf)} if self.central else info


class _Silent:
    """Takes the place of rl_games' writer of TensorBoard files: rlcli logs."""

    def add_scalar(self, *_: Any, **__: Any) -> None:
        """Nothing."""


class RlGamesTrainer(ABC):
    """What PPO and SAC have in common.

    Args:
        env: the environment.
        config: the agent.
        seed: of the networks and of exploration.
        device: where networks and samples live, as the environment does.
        torch_threads: threads of everything but the environment's step.
    """

    agent: Any

    def __init__(self, env: VecEnv, config: RlGamesConfig, *, seed: int, device: str, torch_threads: int) -> None:
        self.env, self.config, self.torch_threads = env, config, torch_threads
        self.iteration, self.env_steps = 0, 0
        env.final_obs_of = "truncated"
        settings = self._settings()
        self.bootstrap = config.bootstrap if settings["value_bootstrap"] else "none"
        self.vec = RlGamesVecEnv(
            env,
            central=settings.get("central_value_config") is not None,
            time_outs=self.bootstrap == "pre_step",
            threads=torch_threads,
        )
        if self.vec.central and "critic" not in env.layout.observations:
            hint = f"groups of the task: {', '.join(env.layout.observations)}"
            raise self._problem("central_value_config", "the task has no observation group critic", hint)
        self.statistics = self.vec.statistics
        self.spec = self._policy_spec()
        torch.set_num_threads(torch_threads)
        seed_generators(derive(seed, "trainer"))
        with tempfile.TemporaryDirectory(prefix="rlcli-rl-games-") as folder, _quietly():
            self.agent = self._make(self._parameters(settings, device, folder))
            self.agent.writer.close()
        self.agent.writer = _Silent()
        self.agent.vec_env = self.vec
        with _quietly():
            self.agent.init_tensors()
        self._recorded = torch.zeros(0, self.spec.observation_size)

    @abstractmethod
    def _make(self, parameters: dict[str, Any]) -> Any:
        """rl_games' agent."""

    @abstractmethod
    def _policy_spec(self) -> PolicySpec:
        """What the trained policy is made of."""

    @abstractmethod
    def _epoch(self) -> tuple[float, dict[str, float]]:
        """One iteration: seconds of the update, and metrics."""

    @abstractmethod
    def _modules(self) -> dict[str, torch.nn.Module]:
        """What has weights."""

    @abstractmethod
    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """What has a state about them."""

    @abstractmethod
    def _policy_tensors(self) -> dict[str, Tensor]:
        """Copies of the actor's weights under the names of a saved policy; it computes what rl_games computes."""

    @abstractmethod
    def load_weights(self, policy: Mapping[str, Tensor]) -> None:
        """Take a policy's weights, with its normaliser; critics stay as they are."""

    def start(self) -> None:
        """Reset the environment to its first episodes."""
        self._take_in(self.env.reset(seed=self.env.seed))

    def iterate(self) -> Report:
        """Collect experience, and update."""
        physics, step = self.env.seconds["physics"], self.env.seconds["step"]
        begin = time.perf_counter()
        update, losses = self._epoch()
        total = time.perf_counter() - begin
        self.iteration += 1
        self.env_steps += self.steps_per_iteration
        self._record(self.agent.obs["obs"])
        self._require_finite(losses)
        physics, step = self.env.seconds["physics"] - physics, self.env.seconds["step"] - step
        seconds = {"physics": physics, "task": step - physics, "policy": total - update - step, "update": update}
        task = {name: value for name, value in self.env.extras().items() if math.isfinite(value)}
        return Report({**self.statistics.flush(), **task, **losses}, seconds)

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of an iteration, over all environments."""
        return self._horizon() * self.env.num_envs

    @abstractmethod
    def _horizon(self) -> int:
        """Steps an environment and iteration."""

    def policy(self) -> Policy:
        """The deployable policy as it is now, with weights of its own."""
        policy = Policy(self.spec)
        policy.load_state_dict(self._policy_tensors())
        return policy.eval().requires_grad_(False)

    def state(self) -> TrainerState:
        """A copy of everything that the next iteration depends on."""
        rest = {"observations": self._recorded.clone(), "dones": self.agent.dones.clone()}
        for part, module in self._modules().items():
            rest |= {f"{part}.{name}": value.detach().clone() for name, value in module.state_dict().items()}
        for name, optimizer in self._optimizers().items():
            rest |= optimizer_tensors(optimizer, f"optimizer.{name}.")
        values = {
            "policy": self.spec.model_dump(mode="json"),
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "epoch": self.agent.epoch_num,
            "statistics": self.statistics.state(),
        }
        tensors = {"policy": self._policy_tensors(), "trainer": rest, "env": self.env.state_dict(), "rng": rng_state()}
        return TrainerState(tensors, values)

    def load(self, state: TrainerState) -> None:
        """Go back to a boundary: the next iteration gives the same bits as it did then."""
        values, rest = state.values, state.tensors["trainer"]
        for part, module in self._modules().items():
            module.load_state_dict(below(rest, f"{part}."))
        for name, optimizer in self._optimizers().items():
            load_optimizer(optimizer, rest, f"optimizer.{name}.")
        self.agent.dones = rest["dones"].clone()
        self.agent.epoch_num = values["epoch"]
        self.iteration, self.env_steps = values["iteration"], values["env_steps"]
        self.agent.frame = self.env_steps
        self.statistics.load(values["statistics"])
        self.agent.obs = self.agent.obs_to_tensors(self.vec.observe(self.env.load_state_dict(state.tensors["env"])))
        self._recorded = rest["observations"]
        load_rng_state(state.tensors["rng"])

    def _take_in(self, obs: Mapping[str, Tensor]) -> None:
        self.agent.obs = self.agent.obs_to_tensors(self.vec.observe(obs))
        self._record(obs["policy"])

    def _record(self, obs: Tensor) -> None:
        self._recorded = torch.cat([obs[:_RECORDED].cpu(), self._recorded])[:_RECORDED]

    def _require_finite(self, losses: Mapping[str, float]) -> None:
        for name, value in losses.items():
            if not math.isfinite(value):
                raise DivergedError(f"{name} is not finite in iteration {self.iteration}", hint=_LEARNER_HINT)
        for part, module in self._modules().items():
            for name, parameter in module.named_parameters():
                if not bool(parameter.isfinite().all()):
                    message = f"weight '{part}.{name}' is not finite in iteration {self.iteration}"
                    raise DivergedError(message, hint=_LEARNER_HINT)

    # --- settings ---

    def _settings(self) -> dict[str, Any]:
        """`params.config` as rl_games reads it; null is a key that is not there."""
        config: Any = self.config
        return config.params.config.model_dump(exclude_none=True)

    def _parameters(self, settings: dict[str, Any], device: str, folder: str) -> dict[str, Any]:
        """All of `params`, as rl_games' runner hands them to an agent."""
        config: Any = self.config
        shaper = DefaultRewardsShaper(**settings["reward_shaper"])
        if self.config.max_iterations is not None:
            epochs = self.config.max_iterations
        else:
            assert self.config.max_steps is not None
            epochs = -(-self.config.max_steps // self.steps_per_iteration)
        own = {
            "name": "rlcli",
            "full_experiment_name": "rlcli",
            "env_name": "rlcli",
            "train_dir": folder,
            "device": device,
            "device_name": device,
            "num_actors": self.env.num_envs,
            "max_epochs": epochs,
            "print_stats": False,
            "env_info": self.vec.spaces(self.config.action_bound or 1.0),
            "vec_env": self.vec,
            "features": {"observer": AlgoObserver()},
        }
        network = {key: _nones(part) for key, part in config.params.network.model_dump().items() if part is not None}
        parts = {"algo": {"name": config.params.algo.name}, "model": {"name": config.params.model.name}}
        return {**parts, "network": network, "config": {**settings, **own, "reward_shaper": shaper}}

    def _problem(self, key: str, message: str, hint: str) -> ConfigError:
        at = ("agents", self.env.resolved.agent_name or "", "params", "config", key)
        return ConfigError([self.env.resolved.problem(at, message, hint)])

    # --- the normaliser of observations, which a saved policy has in another form ---

    def _normalizer_tensors(self) -> dict[str, Tensor]:
        if not self.spec.normalize:
            return {}
        own = self.agent.model.running_mean_std
        return {
            "normalizer.mean": own.running_mean.clone(),
            "normalizer.var": own.running_var + (_EPSILON - 1e-8),
            "normalizer.count": own.count.clone(),
        }

    def _load_normalizer(self, policy: Mapping[str, Tensor]) -> None:
        if self.spec.normalize:
            own = self.agent.model.running_mean_std
            own.running_mean = policy["normalizer.mean"].clone()
            own.running_var = policy["normalizer.var"] - (_EPSILON - 1e-8)
            own.count = policy["normalizer.count"].clone()


class PpoTrainer(RlGamesTrainer):
    """rl_games' PPO."""

    config: PpoConfig

    def _make(self, parameters: dict[str, Any]) -> Any:
        config = self.config.params.config
        size = config.minibatch_size or self.env.num_envs * (config.minibatch_size_per_env or 0)
        central = config.central_value_config
        sizes = {"minibatch_size": size, **({"central_value_config": central.minibatch_size} if central else {})}
        for key, wanted in sizes.items():
            if self.steps_per_iteration % wanted:
                message = f"minibatches of {wanted} samples do not divide a rollout of horizon_length x num_envs ="
                message += f" {config.horizon_length} x {self.env.num_envs} = {self.steps_per_iteration}"
                raise self._problem(key, message, f"{self.steps_per_iteration}, or a divisor of it")
        parameters["config"] = {**_NEEDED, **parameters["config"]}
        agent = A2CAgent("rlcli", parameters)
        if agent.has_central_value:
            agent.central_value_net.writter = _Silent()
        if self.bootstrap == "final_obs":
            agent.rewards_shaper = self._with_what_follows(agent, agent.rewards_shaper)
        return agent

    def _with_what_follows(self, agent: Any, shaper: Any) -> Any:
        """Rewards as rl_games shapes them; a step that ran out of time also earns the value of its last observation."""

        def shape(reward: Tensor) -> Tensor:
            shaped, step = shaper(reward), self.vec.result
            assert step is not None
            if step.final_obs is None:
                return shaped
            value = agent.get_values(self.vec.observe(step.final_obs))
            return shaped + agent.gamma * torch.where(self.vec.cut[:, None], value, 0.0)

        return shape

    def _horizon(self) -> int:
        return self.config.params.config.horizon_length

    def _policy_spec(self) -> PolicySpec:
        params = self.config.params
        return PolicySpec(
            observation_size=self.env.layout.size("policy"),
            action_size=self.env.layout.action_size,
            hidden=params.network.mlp.units,
            activation=_ACTIVATIONS.get(params.network.mlp.activation, params.network.mlp.activation),  # type: ignore[arg-type]
            action_bound=self.config.action_bound,
            normalize=params.config.normalize_input,
            normalize_clip=_OBSERVATION_CLIP,
        )

    def _epoch(self) -> tuple[float, dict[str, float]]:
        agent = self.agent
        agent.update_epoch()
        _, _, update, _, actor, critic, bounds, entropies, divergences, _, _ = agent.train_epoch()
        agent.dataset.update_values_dict(None)
        agent.frame += agent.curr_frames
        losses = {"surrogate": actor, "value": critic, "bounds": bounds, "entropy": entropies, "kl": divergences}
        metrics = {f"Loss/{name}": _mean(values) for name, values in losses.items() if values}
        metrics["Loss/learning_rate"] = float(agent.last_lr)
        metrics["Policy/mean_std"] = float(agent.model.a2c_network.sigma.detach().exp().mean())
        return update, metrics

    def state(self) -> TrainerState:
        """A copy of everything that the next iteration depends on."""
        state = super().state()
        state.values["learning_rate"] = float(self.agent.last_lr)
        if self.agent.has_central_value:
            central = self.agent.central_value_net
            state.values["central"] = {"lr": float(central.lr), "epoch_num": central.epoch_num, "frame": central.frame}
        return state

    def load(self, state: TrainerState) -> None:
        """Go back to a boundary: the next iteration gives the same bits as it did then."""
        super().load(state)
        self.agent.last_lr = state.values["learning_rate"]
        self.agent.update_lr(self.agent.last_lr)
        if self.agent.has_central_value:
            for name in ("lr", "epoch_num", "frame"):
                setattr(self.agent.central_value_net, name, state.values["central"][name])
            self.agent.central_value_net.update_lr(self.agent.central_value_net.lr)

    def load_weights(self, policy: Mapping[str, Tensor]) -> None:
        """Take a policy's weights, with its normaliser; a critic that shares its network keeps its own output."""
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
        """rl_games' name of each weight of the actor -> its name in a saved policy."""
        last = 2 * len(self.spec.hidden)
        names = {f"mu.{kind}": f"actor.{last}.{kind}" for kind in ("weight", "bias")}
        for name in self.agent.model.a2c_network.state_dict():
            if name.startswith("actor_mlp."):
                names[name] = f"actor.{name.removeprefix('actor_mlp.')}"
        return names

    def _policy_tensors(self) -> dict[str, Tensor]:
        weights = self.agent.model.a2c_network.state_dict()
        tensors = {ours: weights[theirs].detach().clone() for theirs, ours in self._names().items()}
        return {**tensors, "log_std": weights["sigma"].detach().clone(), **self._normalizer_tensors()}


class ReplayBuffer(VectorizedReplayBuffer):
    """rl_games' own, into which time-outs come with their true last observation, and not as ends.

    Args:
        vec: what the transitions come from.
        plain: the buffer that this one takes the place of.
    """

    def __init__(self, vec: RlGamesVecEnv, plain: VectorizedReplayBuffer) -> None:
        vars(self).update(vars(plain))
        self.vec = vec

    def add(self, obs: Tensor, action: Tensor, reward: Tensor, next_obs: Tensor, done: Tensor) -> None:
        """Take in a step of every environment."""
        step = self.vec.result
        assert step is not None
        if step.final_obs is not None:
            next_obs = torch.where(self.vec.cut[:, None], step.final_obs["policy"], next_obs)
        super().add(obs, action, reward, next_obs, step.terminated[:, None])


class SacTrainer(RlGamesTrainer):
    """rl_games' SAC."""

    config: SacConfig

    def _make(self, parameters: dict[str, Any]) -> Any:
        config = self.config.params.config
        if config.replay_buffer_size < self.env.num_envs:
            message = (
                f"the buffer of {config.replay_buffer_size} does not hold a step of {self.env.num_envs} environments"
            )
            raise self._problem("replay_buffer_size", message, f"at least {self.env.num_envs}")
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
            activation=_ACTIVATIONS.get(params.network.mlp.activation, params.network.mlp.activation),  # type: ignore[arg-type]
            action_bound=self.config.action_bound,
            normalize=params.config.normalize_input,
            normalize_clip=_OBSERVATION_CLIP,
            log_std_range=params.network.log_std_bounds,
        )

    def _epoch(self) -> tuple[float, dict[str, float]]:
        agent = self.agent
        agent.epoch_num += 1
        _, _, update, _, actor, entropies, alphas, temperature, critic, _ = agent.train_epoch()
        agent.frame += agent.num_frames_per_epoch
        losses = {"actor": actor, "critic": critic, "entropy": entropies, "entropy_coefficient": alphas}
        losses["temperature"] = [value for value in temperature if value is not None]
        return update, {f"Loss/{name}": _mean(values) for name, values in losses.items() if values}

    def state(self) -> TrainerState:
        """A copy of everything that the next iteration depends on."""
        state, buffer = super().state(), self.agent.replay_buffer
        state.tensors["trainer"]["log_alpha"] = self.agent.log_alpha.detach().clone()
        filled = buffer.capacity if buffer.full else buffer.idx
        state.tensors["replay"] = {name: getattr(buffer, name)[:filled].clone() for name in _COLUMNS}
        state.values |= {"replay": {"next": buffer.idx, "full": buffer.full}, "updates": self.agent.update_counter}
        return state

    def load(self, state: TrainerState) -> None:
        """Go back to a boundary: the next iteration gives the same bits as it did then."""
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
        """Take a policy's weights, with its normaliser; critics stay as they are."""
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

    def _policy_tensors(self) -> dict[str, Tensor]:
        last, tensors = 2 * len(self.spec.hidden), {}
        for name, value in self.agent.model.sac_network.actor.state_dict().items():
            _, index, kind = name.split(".")
            if int(index) == last:  # the means, then the logarithms of the deviations
                mean, tensors[f"log_std_head.{kind}"] = (half.clone() for half in value.chunk(2))
                value = mean
            tensors[f"actor.{index}.{kind}"] = value.detach().clone()
        return {**tensors, **self._normalizer_tensors()}


_COLUMNS = ("obses", "actions", "rewards", "next_obses", "dones")


def make_trainer(env: VecEnv, config: RlGamesConfig, *, seed: int, device: str, torch_threads: int) -> RlGamesTrainer:
    """The trainer of an agent."""
    kind = SacTrainer if isinstance(config, SacConfig) else PpoTrainer
    return kind(env, config, seed=seed, device=device, torch_threads=torch_threads)


def _mean(values: list[Any]) -> float:
    return float(torch.stack([torch.as_tensor(value).detach().float().mean() for value in values]).mean())


_NEEDED = {"lr_schedule": None, "bounds_loss_coef": 0.0}
"""What rl_games' PPO fails without: the values that do nothing."""


def _nones(value: Any) -> Any:
    """rl_games writes the name of no activation as a word."""
    if isinstance(value, dict):
        return {key: "None" if item is None and "activation" in key else _nones(item) for key, item in value.items()}
    return copy.deepcopy(value)


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    """rl_games prints what it builds, and calls what torch has deprecated; standard output is for data."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield

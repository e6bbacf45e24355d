"""Trainer that runs RSL-RL's PPO one iteration at a time, with exact save and restore."""

from __future__ import annotations

import contextlib
import copy
import io
import logging
import math
import time
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from rlcli.envs.environment_protocol import Environment
from rlcli.random import derive
from rlcli.registry import is_offered, load_object
from rlcli.rl.nan_check import require_finite_learner
from rlcli.rl.optimizers import load_optimizer, optimizer_tensors, tensors_with_prefix
from rlcli.rl.policy import PolicySpec
from rlcli.rl.rng import load_rng_state, rng_state, seed_generators
from rlcli.rl.trainer import Report, TrainerState
from rlcli.rl.trainer_base import BaseTrainer, agent_error, require_library
from rlcli_rsl_rl.config import RunnerConfig

require_library("rsl-rl", "rsl-rl-lib>=5.5,<6", at_least=(5, 5), below=(6, 0))

from rsl_rl.algorithms import PPO  # noqa: E402
from rsl_rl.models import MLPModel, RNNModel  # noqa: E402
from rsl_rl.modules import GaussianDistribution  # noqa: E402

from rlcli.adapters.rsl_rl import RslRlVecEnv  # noqa: E402

_log = logging.getLogger(__name__)

_ACTIVATIONS = {"swish": "silu"}
_NORMALIZER_EPS = 1e-2
"""RSL-RL adds this number to the standard deviation of observations."""
_LEARNER_HINT = "lower algorithm.learning_rate or algorithm.max_grad_norm; the last good checkpoint is kept"


class RslRlTrainer(BaseTrainer):
    """Trainer that calls RSL-RL's PPO as RSL-RL's own runner does; its state can be saved after any iteration.

    Args:
        env: the environment.
        config: configuration of the agent.
        seed: seed of the initial weights and of exploration.
        device: device of networks and samples; it must be the device of the environment.
        torch_threads: threads of the update; the rollout runs torch on one thread, since two thread pools compete.
    """

    def __init__(self, env: Environment, config: RunnerConfig, *, seed: int, device: str, torch_threads: int) -> None:
        super().__init__(env, torch_threads)
        self.config = config
        self.iteration, self.env_steps = 0, 0
        self.steps_per_iteration = config.num_steps_per_env * env.num_envs
        self._adapter = RslRlVecEnv(env)
        self._groups = _groups(env, config)
        self.spec = _policy_spec(env, config)
        _require_batch(env, config)
        torch.set_num_threads(torch_threads)
        seed_generators(derive(seed, "trainer"))
        with contextlib.redirect_stdout(io.StringIO()):  # RSL-RL prints its networks; stdout is for data
            settings = _settings(env, config, self._groups)
            self.alg = PPO.construct_algorithm(self._adapter.zero_observations(), self._adapter, settings, device)
        self.alg.train_mode()
        self._obs = self._adapter.zero_observations()

    def start(self) -> None:
        """Reset the environment to its first episodes."""
        for key in self.config.not_read:
            _log.warning(f"trainer rsl-rl ignores the setting {key}; remove it")
        obs = self.env.reset(seed=self.env.seed)
        self._obs = self._adapter.observations(obs)
        self.keep_recent_obs(obs["policy"])

    def iterate(self) -> Report:
        """Run one iteration: collect a rollout, then update the networks."""
        before, begin = dict(self.env.seconds), time.perf_counter()
        torch.set_num_threads(1)
        self._collect()
        collected = time.perf_counter()
        torch.set_num_threads(self.torch_threads)
        losses = self.alg.update()
        updated = time.perf_counter()
        self.iteration += 1
        self.env_steps += self.steps_per_iteration
        metrics = self._metrics(losses)
        return self.make_report(metrics, self.split_seconds(before, collected - begin, updated - collected))

    def state(self) -> TrainerState:
        """Return a copy of everything that the next iteration depends on."""
        rest = {"observations": self.recent_obs.clone()}
        for part, module in self._modules().items():
            rest |= {f"{part}.{name}": value.detach().clone() for name, value in module.state_dict().items()}
        for name, optimizer in self._optimizers().items():
            rest |= optimizer_tensors(optimizer, f"optimizer.{name}.")
        for part, network in (("actor", self.alg.actor), ("critic", self.alg.critic)):
            for index, memory in enumerate(network.get_hidden_state() or ()):
                rest[f"memory.{part}.{index}"] = memory.detach().clone()
        values: dict[str, Any] = {
            "policy": self.spec.model_dump(),
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "learning_rate": self.alg.learning_rate,
            "statistics": self.statistics.state(),
        }
        if self.alg.rnd:
            values["rnd_updates"] = self.alg.rnd.update_counter
            average = self._rnd_reward_average()
            if average is not None and average.avg is not None:
                rest["rnd_average"] = average.avg.detach().clone()
        tensors = {"policy": self.policy_tensors(), "trainer": rest, "env": self.env.state_dict(), "rng": rng_state()}
        return TrainerState(tensors, values)

    def load(self, state: TrainerState) -> None:
        """Restore a saved state. On a CPU the next iteration is bit-identical to the one that followed the save."""
        values, rest = state.values, state.tensors["trainer"]
        for part, module in self._modules().items():
            module.load_state_dict(tensors_with_prefix(rest, f"{part}."))
        for name, optimizer in self._optimizers().items():
            load_optimizer(optimizer, rest, f"optimizer.{name}.")
        self.alg.learning_rate = values["learning_rate"]
        for group in self.alg.optimizer.param_groups:
            group["lr"] = values["learning_rate"]
        for part, network in (("actor", self.alg.actor), ("critic", self.alg.critic)):
            memory = tensors_with_prefix(rest, f"memory.{part}.")
            if memory:
                network.reset(hidden_state=tuple(memory[str(index)].clone() for index in range(len(memory))))
        if self.alg.rnd:
            self.alg.rnd.update_counter = values["rnd_updates"]
            if "rnd_average" in rest:
                self._rnd_reward_average().avg = rest["rnd_average"].clone()
        self.iteration, self.env_steps = values["iteration"], values["env_steps"]
        self.statistics.load(values["statistics"])
        self._obs = self._adapter.observations(self.env.load_state_dict(state.tensors["env"]))
        self.recent_obs = rest["observations"].to(self.env.device)
        load_rng_state(state.tensors["rng"])

    def load_weights(self, policy: Mapping[str, Tensor]) -> None:
        """Load the weights of a saved policy and its observation normaliser into the actor; the critic keeps its own.

        `policy` maps the names of a saved policy, as `policy_tensors` returns them, to tensors.
        """
        actor = self.alg.get_policy()
        weights = actor.state_dict()
        for theirs, ours in self._names().items():
            weights[theirs] = policy[ours].clone()
        std = policy["log_std"].exp()
        for name in ("std_param", "log_std_param"):
            if f"distribution.{name}" in weights:
                weights[f"distribution.{name}"] = std if name == "std_param" else std.log()
        if self.spec.normalize:
            deviation = (policy["normalizer.var"] + 1e-8).sqrt() - _NORMALIZER_EPS
            weights["obs_normalizer._mean"] = policy["normalizer.mean"].float()[None]
            weights["obs_normalizer._std"] = deviation.float()[None]
            weights["obs_normalizer._var"] = deviation.square().float()[None]
            weights["obs_normalizer.count"] = policy["normalizer.count"].round().long()
        actor.load_state_dict(weights)

    # --- the rollout ---

    @torch.no_grad()
    def _collect(self) -> None:
        """Take `num_steps_per_env` steps in every environment; then estimate returns."""
        bound, pre_step = self.config.action_bound, self.config.bootstrap == "pre_step"
        for _ in range(self.config.num_steps_per_env):
            action = self.alg.act(self._obs)
            step = self.env.step(action if bound is None else action.clamp(-bound, bound))
            time_out = step.truncated & ~step.terminated
            reward, extras = step.reward, {}
            if pre_step:
                extras["time_outs"] = time_out
            elif step.final_obs is not None:
                value = self._value(step.final_obs)
                reward = reward + self.alg.gamma * torch.where(time_out, value, 0.0)
            self._obs = self._adapter.observations(step.obs)
            self.alg.process_env_step(self._obs, reward, step.terminated | step.truncated, extras)
            self.statistics.add(step.episodes)
        self.keep_recent_obs(self._obs["policy"])
        self.alg.compute_returns(self._obs)

    def _value(self, obs: dict[str, Tensor]) -> Tensor:
        """Return the critic's value, without changing its hidden state. (num_envs,)"""
        memory = self.alg.critic.get_hidden_state()
        value = self.alg.critic(self._adapter.observations(obs)).squeeze(-1)
        self.alg.critic.reset(hidden_state=memory)
        return value

    # --- metrics ---

    def _metrics(self, losses: Mapping[str, float]) -> dict[str, float]:
        metrics = {f"Loss/{name}": float(value) for name, value in losses.items()}
        metrics["Loss/learning_rate"] = self.alg.learning_rate
        metrics["Policy/mean_std"] = float(self._log_std().exp().mean())
        if self.alg.rnd:
            metrics["Rnd/weight"] = float(self.alg.rnd.weight)
        require_finite_learner(metrics, self._modules(), self.iteration, _LEARNER_HINT)
        return metrics

    # --- the content of a checkpoint ---

    def _modules(self) -> dict[str, torch.nn.Module]:
        modules = {"actor": self.alg._raw_actor, "critic": self.alg._raw_critic}
        return {**modules, "rnd": self.alg.rnd} if self.alg.rnd else modules

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        optimizers = {"policy": self.alg.optimizer}
        return {**optimizers, "rnd": self.alg.rnd.optimizer} if self.alg.rnd else optimizers

    def _rnd_reward_average(self) -> Any:
        normalizer = self.alg.rnd.reward_normalizer
        return getattr(normalizer, "disc_avg", None)

    def _names(self) -> dict[str, str]:
        """Return the name of each weight of RSL-RL's actor -> the weight's name in a saved policy of rlcli."""
        names = {}
        for name in self.alg.get_policy().state_dict():
            if name.startswith("mlp."):
                names[name] = f"actor.{name.removeprefix('mlp.')}"
            elif name.startswith("rnn.rnn."):
                kind, _, layer = name.removeprefix("rnn.rnn.").rpartition("_l")
                names[name] = f"memory.layers.{layer}.{kind}"
        return names

    def _log_std(self) -> Tensor:
        distribution = self.alg.get_policy().distribution
        low, high = distribution.log_std_range
        if distribution.std_type == "log":
            return distribution.log_std_param.detach().clamp(low, high)
        return distribution.std_param.detach().clamp(math.exp(low), math.exp(high)).log()

    def policy_tensors(self) -> dict[str, Tensor]:
        """Return copies of the policy's weights, by their names in a saved policy."""
        weights = self.alg.get_policy().state_dict()
        tensors = {ours: weights[theirs].detach().clone() for theirs, ours in self._names().items()}
        tensors["log_std"] = self._log_std().clone()
        if self.spec.normalize:
            # RSL-RL divides by the std + 1e-2, a saved policy by the root of the variance + 1e-8
            deviation = weights["obs_normalizer._std"][0].double() + _NORMALIZER_EPS
            tensors["normalizer.mean"] = weights["obs_normalizer._mean"][0].double()
            tensors["normalizer.var"] = deviation.square() - 1e-8
            tensors["normalizer.count"] = weights["obs_normalizer.count"].double()
        return tensors


def _policy_spec(env: Environment, config: RunnerConfig) -> PolicySpec:
    """Return the structure of the trained policy (sizes, layers, activation), as `policy.json` stores it."""
    actor, _ = config.networks
    memory = config.memory or []
    return PolicySpec(
        kind="gaussian-lstm" if memory else "gaussian-mlp",
        memory=memory,
        observation_size=env.layout.size("policy"),
        action_size=env.layout.action_size,
        hidden=actor.hidden_dims,
        activation=_ACTIVATIONS.get(actor.activation, actor.activation),  # type: ignore[arg-type]
        action_bound=config.action_bound,
        normalize=actor.obs_normalization,
        normalize_clip=None if actor.obs_normalization else 10.0,
    )


def _groups(env: Environment, config: RunnerConfig) -> dict[str, list[str]]:
    """Return the observation groups of the task for each observation set of RSL-RL.

    Raises:
        ConfigError: for a set or group that does not exist.
    """
    have = env.layout.observations
    sets = {"actor": ["policy"], "critic": ["critic"] if "critic" in have else ["policy"]}
    if config.algorithm.rnd_cfg is not None:
        sets["rnd_state"] = ["policy"]
    allowed = {"policy": "actor", "actor": "actor", "critic": "critic", "rnd_state": "rnd_state"}
    for name, groups in config.obs_groups.items():
        if name not in allowed:
            raise agent_error(env, ("obs_groups", name), f"no observation set '{name}'", f"sets: {', '.join(allowed)}")
        for group in groups:
            if group not in have:
                hint = f"groups of the task: {', '.join(have)}"
                raise agent_error(env, ("obs_groups", name), f"no observation group '{group}'", hint)
        if allowed[name] == "actor" and groups != ["policy"]:
            message = f"the actor can read only the observation group 'policy', found {', '.join(groups)}"
            hint = "move the terms of the other groups into observations.policy, and write [policy] here"
            raise agent_error(env, ("obs_groups", name), message, hint)
        if allowed[name] in sets:
            sets[allowed[name]] = list(groups)
    return sets


def _require_batch(env: Environment, config: RunnerConfig) -> None:
    parts = config.algorithm.num_mini_batches
    # minibatches of recurrent networks consist of whole environments, others of single samples
    whole = config.num_steps_per_env if config.memory is not None else 1
    samples = config.num_steps_per_env * env.num_envs // whole
    if samples // parts < 2:
        what = "environments" if whole > 1 else "samples"
        message = f"{parts} minibatches need at least {2 * parts} {what}, but a rollout has {samples}"
        more = "more environments" if whole > 1 else "more environments or num_steps_per_env"
        raise agent_error(env, ("algorithm", "num_mini_batches"), message, f"use {more}, or fewer minibatches")


def _settings(env: Environment, config: RunnerConfig, groups: dict[str, list[str]]) -> dict[str, Any]:
    """Return the settings of RSL-RL's PPO (networks, algorithm, groups) as the dict that RSL-RL 5 reads."""
    algorithm: dict[str, Any] = config.algorithm.model_dump(exclude={"class_name", "rnd_cfg", "symmetry_cfg"})
    algorithm["class_name"] = PPO
    if config.algorithm.rnd_cfg is not None:
        rnd = config.algorithm.rnd_cfg.model_dump(exclude_none=True)
        algorithm["rnd_cfg"] = rnd
    if config.algorithm.symmetry_cfg is not None:
        symmetry = config.algorithm.symmetry_cfg.model_dump()
        symmetry["data_augmentation_func"] = _mirror(env, config.algorithm.symmetry_cfg.data_augmentation_func)
        algorithm["symmetry_cfg"] = symmetry
    actor, critic = config.networks
    return {
        "num_steps_per_env": config.num_steps_per_env,
        "obs_groups": copy.deepcopy(groups),
        "multi_gpu": None,
        "actor": _network(actor),
        "critic": _network(critic),
        "algorithm": algorithm,
    }


def _network(config: Any) -> dict[str, Any]:
    memory = config.class_name == "RNNModel"
    settings = config.model_dump(include={"hidden_dims", "activation", "obs_normalization"})
    settings["class_name"] = RNNModel if memory else MLPModel
    if memory:
        settings |= config.model_dump(include={"rnn_type", "rnn_hidden_dim", "rnn_num_layers"})
    if config.distribution_cfg is not None:
        settings["distribution_cfg"] = config.distribution_cfg.model_dump() | {"class_name": GaussianDistribution}
    return settings


def _mirror(env: Environment, reference: str) -> Any:
    """Import the user's function that appends mirror images of observations and actions (`data_augmentation_func`).

    Args:
        env: the environment.
        reference: `module:function` of the task's package or a plugin, or `file.py:function` beside the task.

    Raises:
        ConfigError: if the module may not be named, or has no such function.
    """
    module, _, name = reference.rpartition(":")
    if not module:
        module, _, name = reference.rpartition(".")
    if module.endswith(".py"):
        root = env.resolved.source.root.resolve()
        file = (root / module).resolve()
        if not file.is_relative_to(root):
            at = ("algorithm", "symmetry_cfg", "data_augmentation_func")
            raise agent_error(env, at, f"'{module}' is outside of the task's folder {root}", "move it beside the task")
        module = str(file)
    elif not is_offered(module, env.resolved.source):
        at = ("algorithm", "symmetry_cfg", "data_augmentation_func")
        message = f"'{module}' belongs neither to the task nor to an installed plugin"
        raise agent_error(env, at, message, "give file.py:function beside the task, or module:function of its package")
    try:
        found = load_object(f"{module}:{name}")
    except (ImportError, AttributeError, OSError, ValueError) as error:
        found, why = None, f": {error}"
    else:
        why = ", which is not a function"
    if not callable(found):
        at = ("algorithm", "symmetry_cfg", "data_augmentation_func")
        hint = "give module:function of the task's package or a plugin, or file.py:function beside the task"
        raise agent_error(env, at, f"no function '{reference}'{why}", hint)
    return found

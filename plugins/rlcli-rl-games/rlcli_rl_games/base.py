"""Base class of the trainers that run rl_games' PPO and SAC."""

from __future__ import annotations

import copy
import tempfile
import time
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from rlcli.envs.environment_protocol import Environment
from rlcli.errors import ConfigError
from rlcli.random import derive
from rlcli.rl.nan_check import require_finite_learner
from rlcli.rl.optimizers import load_optimizer, optimizer_tensors, tensors_with_prefix
from rlcli.rl.policy import PolicySpec
from rlcli.rl.rng import load_rng_state, rng_state, seed_generators
from rlcli.rl.trainer import Report, TrainerState
from rlcli.rl.trainer_base import BaseTrainer, agent_error
from rlcli_rl_games.config import RlGamesConfig
from rlcli_rl_games.library import AlgoObserver, DefaultRewardsShaper, NullWriter, silenced
from rlcli_rl_games.vec_env import RlGamesVecEnv

ACTIVATIONS = {"swish": "silu"}
"""Name of an activation in rl_games -> its name in a saved policy, where they differ."""
OBSERVATION_CLIP = 5.0
"""rl_games clips normalised observations to +-this value."""
_EPSILON = 1e-5
"""rl_games adds this number to the variance of observations."""
_LEARNER_HINT = "lower the learning rate or grad_norm in params.config; the last good checkpoint is kept"


class RlGamesTrainer(BaseTrainer):
    """Base class of the trainers that run rl_games' PPO and SAC.

    Args:
        env: the environment.
        config: configuration of the agent.
        seed: seed of the initial weights and of exploration.
        device: device of networks and samples; it must be the device of the environment.
        torch_threads: threads of torch outside of the environment's step.
    """

    agent: Any

    def __init__(self, env: Environment, config: RlGamesConfig, *, seed: int, device: str, torch_threads: int) -> None:
        super().__init__(env, torch_threads)
        self.config = config
        self.iteration, self.env_steps = 0, 0
        settings = self._settings()
        self.bootstrap = config.bootstrap if settings["value_bootstrap"] else "none"
        self.vec = RlGamesVecEnv(
            env,
            self.statistics,
            central=settings.get("central_value_config") is not None,
            time_outs=self.bootstrap == "pre_step",
            threads=torch_threads,
        )
        if self.vec.central and "critic" not in env.layout.observations:
            hint = f"groups of the task: {', '.join(env.layout.observations)}"
            raise self._error(
                "central_value_config",
                "the task has no observation group 'critic'; add it, or remove central_value_config",
                hint,
            )
        self.spec = self._policy_spec()
        torch.set_num_threads(torch_threads)
        seed_generators(derive(seed, "trainer"))
        with tempfile.TemporaryDirectory(prefix="rlcli-rl-games-") as folder, silenced():
            self.agent = self._make(self._parameters(settings, device, folder))
            self.agent.writer.close()
        self.agent.writer = NullWriter()
        self.agent.vec_env = self.vec
        with silenced():
            self.agent.init_tensors()

    @abstractmethod
    def _make(self, parameters: dict[str, Any]) -> Any:
        """Create rl_games' agent from `params`."""

    @abstractmethod
    def _policy_spec(self) -> PolicySpec:
        """Return the structure of the trained policy."""

    @abstractmethod
    def _epoch(self) -> tuple[float, dict[str, float]]:
        """Run one iteration; return (duration of the update [s], metrics by name)."""

    @abstractmethod
    def _modules(self) -> dict[str, torch.nn.Module]:
        """Return the modules with weights, by name."""

    @abstractmethod
    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Return the optimisers, by name."""

    @abstractmethod
    def load_weights(self, policy: Mapping[str, Tensor]) -> None:
        """Load a policy's weights, with its normaliser; the weights of the critics do not change."""

    def start(self) -> None:
        """Reset the environment to its first episodes."""
        obs = self.env.reset(seed=self.env.seed)
        self.agent.obs = self.agent.obs_to_tensors(self.vec.observe(obs))
        self.keep_recent_obs(obs["policy"])

    def iterate(self) -> Report:
        """Collect a rollout, update the networks, and return the values that the trainer logs.

        Raises:
            DivergedError: if a loss or a weight is not finite.
        """
        before, begin = dict(self.env.seconds), time.perf_counter()
        update, losses = self._epoch()
        total = time.perf_counter() - begin
        self.iteration += 1
        self.env_steps += self.steps_per_iteration
        self.keep_recent_obs(self.agent.obs["obs"])
        require_finite_learner(losses, self._modules(), self.iteration, _LEARNER_HINT)
        return self.make_report(losses, self.split_seconds(before, total - update, update))

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of an iteration, over all environments."""
        return self._horizon() * self.env.num_envs

    @abstractmethod
    def _horizon(self) -> int:
        """Return the steps of each environment in an iteration."""

    def state(self) -> TrainerState:
        """Return a copy of everything that the next iteration depends on."""
        rest = {"observations": self.recent_obs.clone(), "dones": self.agent.dones.clone()}
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
        tensors = {"policy": self.policy_tensors(), "trainer": rest, "env": self.env.state_dict(), "rng": rng_state()}
        return TrainerState(tensors, values)

    def load(self, state: TrainerState) -> None:
        """Restore a saved state. On a CPU the next iteration is bit-identical to the one that followed the save."""
        values, rest = state.values, state.tensors["trainer"]
        for part, module in self._modules().items():
            module.load_state_dict(tensors_with_prefix(rest, f"{part}."))
        for name, optimizer in self._optimizers().items():
            load_optimizer(optimizer, rest, f"optimizer.{name}.")
        self.agent.dones = rest["dones"].clone()
        self.agent.epoch_num = values["epoch"]
        self.iteration, self.env_steps = values["iteration"], values["env_steps"]
        self.agent.frame = self.env_steps
        self.statistics.load(values["statistics"])
        self.agent.obs = self.agent.obs_to_tensors(self.vec.observe(self.env.load_state_dict(state.tensors["env"])))
        self.recent_obs = rest["observations"].to(self.env.device)
        load_rng_state(state.tensors["rng"])

    # --- settings ---

    def _settings(self) -> dict[str, Any]:
        """Return `params.config` as rl_games reads it; a null key is left out."""
        config: Any = self.config
        return config.params.config.model_dump(exclude_none=True)

    def _parameters(self, settings: dict[str, Any], device: str, folder: str) -> dict[str, Any]:
        """Return the whole mapping `params`, in the form in which rl_games' runner passes it to an agent.

        Args:
            settings: `params.config`, from `_settings`.
            device: device of the networks.
            folder: folder to which rl_games may write files.
        """
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
        network = config.params.network.model_dump()
        network = {key: _with_none_activations(part) for key, part in network.items() if part is not None}
        parts = {"algo": {"name": config.params.algo.name}, "model": {"name": config.params.model.name}}
        return {**parts, "network": network, "config": {**settings, **own, "reward_shaper": shaper}}

    def _error(self, key: str, message: str, hint: str) -> ConfigError:
        return agent_error(self.env, ("params", "config", key), message, hint)

    # --- the observation normaliser: a saved policy adds 1e-8 to the variance instead of rl_games' epsilon ---

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


def mean_of(values: list[Any]) -> float:
    """Return the mean of the means of tensors or numbers."""
    return float(torch.stack([torch.as_tensor(value).detach().float().mean() for value in values]).mean())


def _with_none_activations(value: Any) -> Any:
    """Return a copy of settings in which null activations are the string "None", as rl_games expects."""
    if isinstance(value, dict):
        return {
            key: "None" if item is None and "activation" in key else _with_none_activations(item)
            for key, item in value.items()
        }
    return copy.deepcopy(value)

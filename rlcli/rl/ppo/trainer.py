"""Proximal policy optimisation (Schulman et al. 2017): collect a rollout, update actor and critic, repeat.

On a GPU, rollout and update are captured as CUDA graphs and replayed (`rlcli.rl.cuda_graph`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from rlcli.envs.environment_protocol import Environment
from rlcli.errors import DivergedError
from rlcli.random import derive
from rlcli.rl import distributed
from rlcli.rl.budget import remaining_budget
from rlcli.rl.cuda_graph import capture_on_gpu
from rlcli.rl.mlp import use_threads
from rlcli.rl.nan_check import require_finite
from rlcli.rl.optimizers import tensors_with_prefix
from rlcli.rl.ppo.collector import Collector
from rlcli.rl.ppo.config import PpoConfig
from rlcli.rl.ppo.learner import Learner
from rlcli.rl.ppo.networks import ActorCritic
from rlcli.rl.ppo.setup import critic_groups, policy_spec, task_mirror
from rlcli.rl.rng import load_rng_state, rng_state, seed_generators
from rlcli.rl.trainer import Report, TrainerState
from rlcli.rl.trainer_base import BaseTrainer
from rlcli.sim.saved_tensors import require_matching_tensors


class PpoTrainer(BaseTrainer):
    """PPO trainer.

    Args:
        env: the environment.
        config: configuration of the agent.
        seed: seed of the initial weights and of exploration.
        device: device of networks and samples; it must be the device of the environment.
        torch_threads: threads of torch in the update; see `BaseTrainer`.
    """

    def __init__(self, env: Environment, config: PpoConfig, *, seed: int, device: str, torch_threads: int) -> None:
        super().__init__(env, torch_threads)
        self.config, self.device = config, torch.device(device)
        self.process_group = distributed.current()
        self.env_steps = 0
        self.steps_per_iteration = config.num_steps * env.num_envs * self.process_group.world_size
        groups = critic_groups(env, config)
        self.spec = policy_spec(env, config)

        torch.set_num_threads(torch_threads)
        use_threads(max(torch_threads, env.workers) if device == "cpu" else 1)
        seed_generators(derive(seed, "trainer"))
        mirror = task_mirror(env, config)
        self.networks = ActorCritic(env, config, groups, None if mirror is None else mirror.action).to(self.device)
        # all ranks start with equal weights and explore with different noise
        seed_generators(self.process_group.seed(derive(seed, "exploration"), "exploration"))
        self.collector = Collector(env, config, self.networks, self.statistics, mirror)
        self.learner = Learner(self.collector, torch_threads)
        self._collect = capture_on_gpu(self.collector.collect, self.device, env.stateful_objects())
        self._update = capture_on_gpu(self.learner.update, self.device)

    @property
    def iteration(self) -> int:
        """Number of finished iterations."""
        return self.collector.iteration

    def start(self) -> None:
        """Reset the environment to its first episodes."""
        self.collector.set_obs(self.env.reset(seed=self.env.seed))
        self.keep_recent_obs(self.collector.obs["policy"])

    def iterate(self) -> Report:
        """Collect a rollout, update actor and critic, and return metrics and durations.

        Raises:
            DivergedError: if a tensor is not finite, with the first such tensor.
        """
        before, begin = dict(self.env.seconds), time.perf_counter()
        torch.set_num_threads(1)
        try:
            self._collect()
        except DivergedError:
            # if the policy caused the divergence, name its first tensor that is not finite instead
            require_finite(self.collector.rollout_dependencies(), self.iteration + 1)
            raise
        self.keep_recent_obs(self.collector.obs["policy"])
        collected = self._timestamp()
        torch.set_num_threads(self.learner.torch_threads)
        # before the iteration is counted, so that the first one has the whole learning rate
        self.learner.decay_learning_rate(remaining_budget(self.config, self))
        self.collector.iteration += 1
        self.env_steps += self.steps_per_iteration
        self._update()
        updated = self._timestamp()
        losses = self.learner.metrics()
        self.env.check()
        if self.process_group.world_size > 1:
            self.statistics.all_reduce(self.process_group)
        total = time.perf_counter() - begin
        if isinstance(collected, float):
            rollout = collected - begin
            seconds = self.split_seconds(before, rollout, total - rollout)
        else:  # on a GPU the parts of a replayed rollout cannot be timed
            update = collected.elapsed_time(updated) / 1e3
            seconds = {"rollout": total - update, "update": update}
        return self.make_report(losses, seconds)

    def _timestamp(self) -> Any:
        """Return the time [s] as a float; on a GPU a CUDA event in the current stream, which forces no host sync."""
        if self.device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]  # torch has no type here
        event.record(torch.cuda.current_stream(self.device))
        return event

    # --- saving and restoring ---

    def state(self) -> TrainerState:
        """Return a copy of everything that the next iteration depends on."""
        trainer = _copies({**self._learner_tensors(), "observations": self.recent_obs})
        tensors = {"policy": self.policy_tensors(), "trainer": trainer}
        values = {
            "policy": self.spec.model_dump(),
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "processes": self.process_group.world_size,
        }
        for rank, (env, rng, statistics) in enumerate(self.process_group.gather_object(self._process_state())):
            suffix = _suffix(rank)
            tensors[f"env{suffix}"], tensors[f"rng{suffix}"] = env, rng
            values[f"statistics{suffix}"] = statistics
        return TrainerState(tensors, values)

    def _process_state(self) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Any]]:
        """Return the part of the state that each process saves for itself: environments, random generators, statistics.

        Returns:
            Tensors of environments and rollouts; states of the random generators; sums of the episode statistics.
        """
        rng = rng_state()
        if self.device.type == "cuda":
            rng["cuda"] = torch.cuda.get_rng_state(self.device)
        env = {name: value.cpu() for name, value in self.env.state_dict().items()}
        return {**env, **_copies(self._episode_tensors())}, rng, self.statistics.state()

    def load(self, state: TrainerState) -> None:
        """Restore a saved state. On a CPU the next iteration is bit-identical to the one that followed the save.

        If the number of processes has changed, the learner continues and every environment starts a new episode.
        """
        values, saved = state.values, state.tensors["trainer"]
        require_matching_tensors(saved, self._learner_tensors(), "trainer")
        self.load_weights(state.tensors["policy"])
        with torch.no_grad():
            for name, value in self._learner_tensors().items():
                value.copy_(saved[name])
        self.recent_obs = saved["observations"].to(self.device)
        self.collector.iteration, self.env_steps = values["iteration"], values["env_steps"]
        if values["processes"] != self.process_group.world_size:
            self.collector.episode_start.fill_(1.0)
            self.statistics.load(values["statistics"])
            torch.manual_seed(derive(torch.initial_seed(), f"after {self.env_steps} steps"))
            self.collector.set_obs(self.env.reset(seed=derive(self.env.seed, f"after {self.env_steps} steps")))
            return
        suffix = _suffix(self.process_group.rank)
        self.statistics.load(values[f"statistics{suffix}"])
        env = state.tensors[f"env{suffix}"]
        require_matching_tensors(env, self._episode_tensors(), "env")
        for name, value in self._episode_tensors().items():
            value.copy_(env[name])
        self.collector.set_obs(self.env.load_state_dict(env))
        rng = state.tensors[f"rng{suffix}"]
        load_rng_state(rng)  # last: `load_state_dict` of a task may draw random numbers
        if self.device.type == "cuda" and "cuda" in rng:
            torch.cuda.set_rng_state(rng["cuda"], self.device)

    def load_weights(self, policy: Mapping[str, Tensor]) -> None:
        """Load the weights and the normaliser of a saved policy (`--init-from`); the critic does not change."""
        self.networks.load_policy_tensors(policy)
        if self.collector.normalizer is not None:
            self.collector.normalizer.load_state_dict(tensors_with_prefix(policy, "normalizer."))

    def policy_tensors(self) -> dict[str, Tensor]:
        """Return copies of the policy's weights, by their names in a saved policy."""
        normalizer = _module_tensors("normalizer", self.collector.normalizer)
        return _copies({**self.networks.policy_tensors(), **normalizer})

    def _learner_tensors(self) -> dict[str, Tensor]:
        """Return tensors of critic, normalisers and optimiser, not copied, by their names in a checkpoint."""
        tensors: dict[str, Tensor] = {
            name: value
            for name, value in self.networks.named_parameters()
            if not name.startswith(("actor.", "memory.", "vision."))
        }
        tensors |= _module_tensors("critic_normalizer", self.collector.critic_normalizer)
        tensors |= _module_tensors("value_normalizer", self.collector.value_normalizer)
        slots = self.learner.optimizer.state[self.learner.weights]
        optimizer = {f"optimizer.{slot}": value for slot, value in slots.items()}
        return {**tensors, **optimizer, "learning_rate": self.learner.learning_rate}

    def _episode_tensors(self) -> dict[str, Tensor]:
        """Return starts of episodes and hidden states between rollouts, not copied, by their names in a checkpoint."""
        states = {f"memory.{name}": value for name, value in self.collector.hidden_state.items()}
        return {"begins": self.collector.episode_start, **states}


def _copies(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return copies of tensors on the CPU."""
    return {name: value.detach().to("cpu", copy=True) for name, value in tensors.items()}


def _module_tensors(name: str, module: nn.Module | None) -> dict[str, Tensor]:
    """Return the tensors of a module, not copied, by `name.TENSOR`; an empty dict without a module."""
    return {} if module is None else {f"{name}.{key}": value for key, value in module.state_dict().items()}


def _suffix(rank: int) -> str:
    """Return the suffix of a rank's files and entries in a checkpoint; rank 0 has none."""
    return f".{rank}" if rank else ""

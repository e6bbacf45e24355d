"""Proximal policy optimisation (Schulman et al. 2017): collect a rollout, update actor and critic, repeat.

On a GPU the rollout and the update are each captured once as a CUDA graph and replayed (`rlcli.rl.cuda_graph`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.errors import DivergedError
from rlcli.random import derive
from rlcli.rl import distributed
from rlcli.rl.budget import Budget
from rlcli.rl.cuda_graph import captured
from rlcli.rl.nan_check import require_finite
from rlcli.rl.optimizers import below
from rlcli.rl.ppo.collector import Collector
from rlcli.rl.ppo.config import PpoConfig
from rlcli.rl.ppo.learner import Learner
from rlcli.rl.ppo.networks import ActorCritic
from rlcli.rl.ppo.setup import critic_groups, policy_spec, vision_spec
from rlcli.rl.rng import load_rng_state, rng_state, seed_generators
from rlcli.rl.trainer import Report, TrainerState
from rlcli.rl.trainer_base import BaseTrainer
from rlcli.sim.tensor_state import require_matching_tensors


class PpoTrainer(BaseTrainer):
    """PPO, one iteration at a time.

    Args:
        env: the environment.
        config: the agent.
        seed: of the networks and of exploration.
        device: device of the networks and the samples, that of the environment.
        torch_threads: threads of the update; the rollout runs torch on one thread, since two thread pools compete.
    """

    def __init__(self, env: VecEnv, config: PpoConfig, *, seed: int, device: str, torch_threads: int) -> None:
        super().__init__(env, torch_threads)
        self.config, self.device = config, torch.device(device)
        self.process_group = distributed.current()
        self.env_steps = 0
        self.steps_per_iteration = config.num_steps * env.num_envs * self.process_group.world_size
        groups = critic_groups(env, config)
        self.spec = policy_spec(env, config)

        torch.set_num_threads(torch_threads)
        seed_generators(derive(seed, "trainer"))
        self.networks = ActorCritic(
            env.layout.size("policy"),
            sum(env.layout.size(group) for group in groups),
            env.layout.action_size,
            config,
            self.spec.vision,
            vision_spec(env, config, groups),
        ).to(self.device)
        seed_generators(self.process_group.seed(derive(seed, "exploration"), "exploration"))
        self.collector = Collector(env, config, self.networks, groups, self.statistics, self.process_group)
        self.learner = Learner(self.collector, config, self.process_group, torch_threads)
        self._collect = captured(self.collector.collect, self.device, env.stateful_objects())
        self._update = captured(self.learner.update, self.device)

    @property
    def iteration(self) -> int:
        """Iterations done."""
        return self.collector.iteration

    def start(self) -> None:
        """Reset the environment to its first episodes."""
        self.collector.set_obs(self.env.reset(seed=self.env.seed))
        self._keep_recent_obs(self.collector.obs["policy"])

    def iterate(self) -> Report:
        """Collect a rollout, then update."""
        before, begin = dict(self.env.seconds), time.perf_counter()
        torch.set_num_threads(1)
        try:
            self._collect()
        except DivergedError:
            require_finite(
                self.collector.rollout_dependencies(), self.iteration + 1
            )  # the cause, if it is not the task
            raise
        self._keep_recent_obs(self.collector.obs["policy"])
        collected = self._timestamp()
        torch.set_num_threads(self.learner.torch_threads)
        spent = Budget(self.config.max_iterations, self.config.max_steps).share(self)
        self.learner.decay_learning_rate(max(0.0, 1.0 - spent))
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
            seconds = self._split_seconds(before, rollout, total - rollout)
        else:  # the parts of a replayed rollout cannot be timed
            update = collected.elapsed_time(updated) / 1e3
            seconds = {"rollout": total - update, "update": update}
        return self._report(losses, seconds)

    def _timestamp(self) -> Any:
        """Return the time, or on a GPU an event in the order of its work, which forces no host sync."""
        if self.device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)  # type: ignore[no-untyped-call]  # torch has no type here
        event.record(torch.cuda.current_stream(self.device))
        return event

    # --- saving and restoring ---

    def state(self) -> TrainerState:
        """Return a copy of everything that the next iteration depends on."""
        tensors = {
            "policy": self._policy_tensors(),
            "trainer": {name: _copy(value) for name, value in self._learner_tensors().items()},
        }
        tensors["trainer"]["observations"] = _copy(self._recent_obs)
        values = {
            "policy": self.spec.model_dump(),
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "processes": self.process_group.world_size,
        }
        for rank, (env, rng, statistics) in enumerate(self.process_group.gather_object(self._process_state())):
            suffix = f".{rank}" if rank else ""
            tensors[f"env{suffix}"], tensors[f"rng{suffix}"] = env, rng
            values[f"statistics{suffix}"] = statistics
        return TrainerState(tensors, values)

    def _process_state(self) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Any]]:
        """Return what differs between processes: environments, random generators, statistics."""
        rng = rng_state()
        if self.device.type == "cuda":
            rng["cuda"] = torch.cuda.get_rng_state(self.device)
        env = {name: value.cpu() for name, value in self.env.state_dict().items()}
        env |= {name: _copy(value) for name, value in self._episode_tensors().items()}
        return env, rng, self.statistics.state()

    def load(self, state: TrainerState) -> None:
        """Restore a state: on a CPU the next iteration gives the same bits as it did then.

        With another number of processes than then, the learner continues, in new episodes.
        """
        values, saved = state.values, state.tensors["trainer"]
        require_matching_tensors(saved, self._learner_tensors(), "trainer")
        self.load_weights(state.tensors["policy"])
        with torch.no_grad():
            for name, value in self._learner_tensors().items():
                value.copy_(saved[name])
        self._recent_obs = saved["observations"].to(self.device)
        self.collector.iteration, self.env_steps = values["iteration"], values["env_steps"]
        if values["processes"] != self.process_group.world_size:
            self.collector.episode_start.fill_(1.0)
            self.statistics.load(values["statistics"])
            torch.manual_seed(derive(torch.initial_seed(), f"after {self.env_steps} steps"))
            self.collector.set_obs(self.env.reset(seed=derive(self.env.seed, f"after {self.env_steps} steps")))
            return
        suffix = f".{self.process_group.rank}" if self.process_group.rank else ""
        self.statistics.load(values[f"statistics{suffix}"])
        env = state.tensors[f"env{suffix}"]
        require_matching_tensors(env, self._episode_tensors(), "env")
        for name, value in self._episode_tensors().items():
            value.copy_(env[name])
        self.collector.set_obs(self.env.load_state_dict(env))
        rng = state.tensors[f"rng{suffix}"]
        load_rng_state(rng)
        if self.device.type == "cuda" and "cuda" in rng:
            torch.cuda.set_rng_state(rng["cuda"], self.device)

    def load_weights(self, policy: Mapping[str, Tensor]) -> None:
        """Load a policy's weights, with its normaliser; the critic keeps its own."""
        self.networks.load_policy_tensors(policy)
        if self.collector.normalizer is not None:
            self.collector.normalizer.load_state_dict(below(policy, "normalizer."))

    def _policy_tensors(self) -> dict[str, Tensor]:
        tensors = {name: _copy(value) for name, value in self.networks.policy_tensors().items()}
        if self.collector.normalizer is not None:
            state = self.collector.normalizer.state_dict()
            tensors.update({f"normalizer.{name}": _copy(value) for name, value in state.items()})
        return tensors

    def _learner_tensors(self) -> dict[str, Tensor]:
        """Return, uncopied, everything that the learner depends on except the policy."""
        tensors = {
            name: value
            for name, value in self.networks.named_parameters()
            if not name.startswith(("actor.", "memory.", "vision."))
        }
        for name in ("critic_normalizer", "value_normalizer"):
            module = getattr(self.collector, name)
            if module is not None:
                tensors.update({f"{name}.{key}": value for key, value in module.state_dict().items()})
        slots = self.learner.optimizer.state[self.learner.weights]
        optimizer = {f"optimizer.{slot}": value for slot, value in slots.items()}
        return {**tensors, **optimizer, "learning_rate": self.learner.learning_rate}

    def _episode_tensors(self) -> dict[str, Tensor]:
        """Return, uncopied, what the collector carries from one rollout to the next, by its name in a checkpoint."""
        states = {f"memory.{name}": value for name, value in self.collector.hidden_state.items()}
        return {"begins": self.collector.episode_start, **states}


def _copy(value: Tensor) -> Tensor:
    return value.detach().to("cpu", copy=True)

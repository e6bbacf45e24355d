"""Base class `BaseTrainer` of all trainers, and functions that trainers share.

The base class keeps episode statistics and the newest observations, and makes the report of an iteration.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from importlib import metadata

import torch
from torch import Tensor

from rlcli.envs.environment_protocol import Environment
from rlcli.errors import ConfigError, DependencyError, pip_install
from rlcli.rl.episode_statistics import EpisodeStatistics
from rlcli.rl.policy import Policy, PolicySpec
from rlcli.rl.trainer import Report

_RECENT_OBS = 256
"""Number of observations that a checkpoint stores; an exported file is tested with them against the policy."""


class BaseTrainer(ABC):
    """Trainer with an environment, episode statistics, recent observations and a report.

    A subclass sets `spec`, implements `policy_tensors` and the members of `rlcli.rl.trainer.Trainer` that are missing
    here, and returns the result of `make_report` from `iterate`.

    Args:
        env: the environment.
        torch_threads: number of threads that torch has in the update. In the rollout torch has one thread, so that its
            thread pool does not compete with the engine's.
    """

    spec: PolicySpec
    """Structure of the policy."""

    def __init__(self, env: Environment, torch_threads: int) -> None:
        self.env, self.torch_threads = env, torch_threads
        env.final_obs_of = "truncated"
        self.statistics = EpisodeStatistics(env.config.episode_length_s)
        """Statistics of the episodes that end in the rollout: call `statistics.add(result.episodes)` in every step."""
        self.recent_obs = torch.zeros(0, env.layout.size("policy"), device=env.device)
        """Newest observations of the policy, at most 256 rows. (n, d)

        A checkpoint stores them as `observations` in `trainer.safetensors`; `rlcli export` tests a file with them."""

    @abstractmethod
    def policy_tensors(self) -> dict[str, Tensor]:
        """Return copies of the policy's weights on the CPU, by their names in a saved policy."""

    def policy(self) -> Policy:
        """Return the current policy, ready to be deployed, with a copy of the weights."""
        policy = Policy(self.spec)
        policy.load_state_dict(self.policy_tensors())
        return policy.eval().requires_grad_(False)

    def keep_recent_obs(self, obs: Tensor) -> None:
        """Add the policy's observations after a rollout to `recent_obs`, and drop the oldest rows. (num_envs, d)"""
        self.recent_obs = torch.cat([obs[:_RECENT_OBS], self.recent_obs])[:_RECENT_OBS]

    def split_seconds(self, before: Mapping[str, float], rollout: float, update: float) -> dict[str, float]:
        """Return the durations [s] of the parts of an iteration: physics, task (terms), policy and update.

        Args:
            before: a copy of `env.seconds` from the beginning of the iteration.
            rollout: duration of the rollout [s].
            update: duration of the update [s].
        """
        physics, step = (self.env.seconds[name] - before[name] for name in ("physics", "step"))
        return {"physics": physics, "task": step - physics, "policy": rollout - step, "update": update}

    def make_report(self, losses: Mapping[str, float], seconds: dict[str, float]) -> Report:
        """Return the report of an iteration: episode statistics, metrics of the task, losses, and durations.

        Args:
            losses: metrics of the update, by name, such as `Loss/value`.
            seconds: duration of each part of the iteration, as `split_seconds` returns them [s].
        """
        return Report({**self.statistics.flush(), **finite_values(self.env.extras()), **losses}, seconds)


def finite_values(metrics: Mapping[str, float]) -> dict[str, float]:
    """Return the metrics whose value is finite."""
    return {name: value for name, value in metrics.items() if math.isfinite(value)}


def agent_error(env: Environment, path: tuple[str, ...], message: str, hint: str) -> ConfigError:
    """Return the error for a key of the agent's configuration that does not fit the environment.

    Args:
        env: the environment.
        path: the key in the agent's configuration, such as ("critic", "hidden").
        message: what is wrong.
        hint: what to do.
    """
    return ConfigError([env.resolved.problem(("agents", env.resolved.agent_name or "", *path), message, hint)])


def require_library(trainer: str, needed: str, at_least: tuple[int, int], below: tuple[int, int]) -> None:
    """Check the version of the library that a trainer needs.

    Args:
        trainer: name of the trainer.
        needed: the requirement in pip's form, such as `rsl-rl-lib>=5.5,<6`.
        at_least: lowest allowed version (major, minor).
        below: lowest version (major, minor) that is too new.

    Raises:
        DependencyError: if the library is missing or has another version.
    """
    distribution = needed.partition(">")[0]
    try:
        version = metadata.version(distribution).split(".")[:2]
        fits, found = at_least <= tuple(map(int, version)) < below, f"{distribution} {'.'.join(version)} is"
    except metadata.PackageNotFoundError:
        fits, found = False, f"{distribution} is not"
    if not fits:
        message = f"trainer '{trainer}' needs {needed}, and {found} installed"
        raise DependencyError(message, hint=pip_install(needed))

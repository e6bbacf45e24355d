"""Fixed policies (zero, random, bang-bang, sine) and their recorded rollouts, on which the lint rules run.

Fixed policies need no training, so the linter can run before any training.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from rlcli.envs.managed import ManagedEnv
from rlcli.envs.observers import StepObserver
from rlcli.envs.vec_env import VecEnv
from rlcli.progress import tracked
from rlcli.testing.steps import EndedEpisode, ended_episodes
from rlcli.testing.task_under_test import TaskUnderTest, element_names

MAX_STEPS = 1000
"""Largest length of a rollout [steps], if the user sets no duration (`rlcli lint --seconds`)."""
FixedPolicy = Callable[[int], Tensor]
"""Function from the index of a step to the actions of all environments. (num_envs, a)"""

SWITCH_S = 0.25
"""Mean time between sign changes of the bang-bang policy [s]."""
SINE_HZ = (0.25, 2.0)
"""Frequencies of the sine policy [Hz]."""


def zero(env: VecEnv, bound: float) -> FixedPolicy:
    """Return a policy whose actions are always zero."""
    return lambda step: torch.zeros(env.num_envs, env.layout.action_size)


def uniform(env: VecEnv, bound: float) -> FixedPolicy:
    """Return a policy that samples each action uniformly within the bound."""
    generator = torch.Generator().manual_seed(env.seed)
    shape = (env.num_envs, env.layout.action_size)
    return lambda step: (torch.rand(shape, generator=generator) * 2.0 - 1.0) * bound


def bang_bang(env: VecEnv, bound: float) -> FixedPolicy:
    """Return a policy whose actions are always +bound or -bound; each column changes its sign at random times."""
    generator = torch.Generator().manual_seed(env.seed + 1)
    shape = (env.num_envs, env.layout.action_size)
    sign = torch.where(torch.rand(shape, generator=generator) < 0.5, -1.0, 1.0)
    switches = min(0.5, env.step_dt / SWITCH_S)

    def act(step: int) -> Tensor:
        sign.mul_(torch.where(torch.rand(shape, generator=generator) < switches, -1.0, 1.0))
        return sign * bound

    return act


def sine(env: VecEnv, bound: float) -> FixedPolicy:
    """Return a policy of sine waves with the bound as amplitude; each column has its own frequency and phase."""
    generator = torch.Generator().manual_seed(env.seed + 2)
    frequency, phase = torch.rand(2, env.num_envs, env.layout.action_size, generator=generator).unbind(0)
    low, high = SINE_HZ
    turn = 2.0 * math.pi * env.step_dt * (low + (high - low) * frequency)
    return lambda step: bound * torch.sin(2.0 * math.pi * phase + turn * step)


FIXED_POLICIES: dict[str, Callable[[VecEnv, float], FixedPolicy]] = {
    "zero": zero,
    "random": uniform,
    "bang-bang": bang_bang,
    "sine": sine,
}
"""Name of a policy -> function (environment, action bound) that returns the policy, in the order of the rollouts."""


@dataclass(slots=True)
class Rollout:
    """Rollout of one fixed policy in a task. Tensors are (steps, num_envs, ...)."""

    policy: str
    """Name of the policy, a key of `FIXED_POLICIES`."""
    env: VecEnv
    reward: Tensor
    done: Tensor
    """Whether the episode ended with this step. bool"""
    terminated: Tensor
    """Whether a termination ended the episode with this step. bool"""
    terms: dict[str, Tensor]
    """Reward term -> its reward, weight included; empty for a direct task."""
    obs: dict[str, Tensor]
    """Group -> observations, beginning with those of the reset. (steps + 1, num_envs, d) each"""
    episodes: list[EndedEpisode]
    """Episodes that ended during the rollout."""
    unfinished: list[int]
    """Lengths of the episodes that the end of the rollout has cut off."""
    limited: dict[str, float]
    """Name of an effort, a control or an action column -> share of the steps in which the quantity was at its limit;
    empty except for the policy `random`."""
    speed: Tensor
    """Root mean square of each velocity (qvel). (nv,)"""
    diverged: int
    """Number of divergences."""
    error: Exception | None = None
    """The error that ended the rollout; None: no error."""


def record_rollout(env: VecEnv, policy: str, bound: float, steps: int) -> Rollout:
    """Reset an environment, run a fixed policy for some steps or until an error, and record the rollout.

    Args:
        env: the environment.
        policy: a key of `FIXED_POLICIES`.
        bound: largest absolute action.
        steps: number of steps.
    """
    act, limits = FIXED_POLICIES[policy](env, bound), policy == "random"
    steps_of: defaultdict[str, list[Tensor]] = defaultdict(list)
    terms: defaultdict[str, list[Tensor]] = defaultdict(list)
    obs: defaultdict[str, list[Tensor]] = defaultdict(list)
    episodes: list[EndedEpisode] = []
    error = None
    physics = _PhysicsObserver(env, limits=limits)
    with env.observers.added(physics):
        try:
            _append(obs, env.reset(seed=env.seed))
            for step in tracked(range(steps), f"policy {policy}, steps", steps):
                action = act(step)
                result = env.step(action)
                done = result.terminated | result.truncated
                _append(steps_of, {"reward": result.reward, "done": done, "terminated": result.terminated})
                if isinstance(env, ManagedEnv):
                    _append(terms, env.reward_manager.values())
                if limits:
                    physics.add_clipped_columns(action)
                _append(obs, result.obs)
                episodes += ended_episodes(result)
        except Exception as raised:
            error = raised
    count = max(1, physics.steps)
    return Rollout(
        policy,
        env,
        reward=_stack(steps_of["reward"], env),
        done=_stack(steps_of["done"], env),
        terminated=_stack(steps_of["terminated"], env),
        terms={name: torch.stack(values) for name, values in terms.items()},
        obs={group: torch.stack(values) for group, values in obs.items()},
        episodes=episodes,
        unfinished=[length for length in env.episode_length_buf.tolist() if length],
        limited={name: total / count for name, total in physics.shares.items()},
        speed=torch.zeros(0) if physics.squares is None else (physics.squares / count).sqrt(),
        diverged=env.divergences,
        error=error,
    )


def _stack(steps: list[Tensor], env: VecEnv) -> Tensor:
    return torch.stack(steps) if steps else torch.zeros(0, env.num_envs)


def _append(lists: defaultdict[str, list[Tensor]], values: dict[str, Tensor]) -> None:
    for name, value in values.items():
        lists[name].append(value.clone())


class _PhysicsObserver(StepObserver):
    """Observer that records velocities after the physics steps, before any reset.

    If `limits`, it also records which efforts, controls and action columns are at their limits.
    """

    def __init__(self, env: VecEnv, *, limits: bool) -> None:
        self._env, self._limits = env, limits
        self.steps = 0
        self.squares: Tensor | None = None
        """Sum over the steps of each squared velocity, averaged over the environments. (nv,)"""
        self.shares: defaultdict[str, float] = defaultdict(float)
        """Name of an effort, control or action column -> sum over the steps of the share of environments in which the
        quantity is at its limit."""

    def after_physics(self) -> None:
        env, model = self._env, self._env.engine.model
        self.steps += 1
        squares = env.engine.field("qvel").double().square().mean(dim=0)
        self.squares = squares if self.squares is None else self.squares + squares
        if not self._limits:
            return
        for entity in env.entities.values():
            if not entity.joint_names:
                continue
            effort, limit = entity.data.computed_effort.abs(), entity.data.joint_effort_limits
            shares = (effort >= limit * (1.0 - 1e-6)).float().mean(dim=0)
            for joint, share in zip(entity.joint_names, shares.tolist(), strict=True):
                self.shares[f"the effort of joint '{joint}'"] += share
        for number in model.actuator_ctrllimited.nonzero()[0].tolist():
            low, high = model.actuator_ctrlrange[number].tolist()
            slack = 1e-6 * (high - low)
            name = f"the control of actuator '{model.actuator(number).name or number}'"
            control = env.engine.field("ctrl")[:, number]
            self.shares[name] += float(((control <= low + slack) | (control >= high - slack)).float().mean())

    def add_clipped_columns(self, action: Tensor) -> None:
        """Record which columns of the action (num_envs, a) are clipped before they become commands."""
        column = 0
        for term in self._env.layout.actions:
            for index, name in enumerate(element_names(term.elements, term.size)):
                clip = None if term.clip is None else term.clip[index]
                if isinstance(clip, tuple):
                    scale = 1.0 if term.scale is None else term.scale[index]
                    offset = 0.0 if term.offset is None else term.offset[index]
                    command = action[:, column] * scale + offset
                    share = float(((command < clip[0]) | (command > clip[1])).float().mean())
                    self.shares[f"column {column} of the action ({name})"] += share
                column += 1


class RolloutEvidence:
    """Data that the lint rules read: a rollout of each fixed policy, recorded on first use, and new environments.

    Args:
        subject: the task.
        seconds: simulated time of each rollout [s]; None: one episode, at most `MAX_STEPS` steps.
    """

    def __init__(self, subject: TaskUnderTest, seconds: float | None) -> None:
        self.subject = subject
        task = subject.resolved.task
        wanted = min(task.max_episode_length, MAX_STEPS) if seconds is None else seconds / task.step_dt
        self.steps = max(1, math.ceil(wanted - 1e-6))
        self._rollouts: list[Rollout] | None = None

    @property
    def rollouts(self) -> list[Rollout]:
        """One rollout of each policy of `FIXED_POLICIES`; all are recorded at the first access."""
        if self._rollouts is None:
            bound = self.subject.bound
            names = tracked(FIXED_POLICIES, "policies", len(FIXED_POLICIES))
            self._rollouts = [record_rollout(self.env(), name, bound, self.steps) for name in names]
        return self._rollouts

    @property
    def stopped(self) -> bool:
        """Whether a recorded rollout ended in an error."""
        return any(rollout.error is not None for rollout in self._rollouts or ())

    def env(self, num_envs: int | None = None, **settings: Any) -> VecEnv:
        """Return a new environment of the task with further settings, such as `sim__dt=0.01` for the key `sim.dt`.

        `num_envs` is the number of environments; None: that of the checks.
        """
        flags = {key.replace("__", "."): value for key, value in settings.items()}
        # all cores: the number of engine threads does not change the results
        return self.subject.env(
            flags={"scene.num_envs": num_envs or self.subject.num_envs, "sim.engine_threads": None, **flags}
        )

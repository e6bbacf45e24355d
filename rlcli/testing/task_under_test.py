"""The task under test: small seeded environments, recorded trajectories, and one recording that checks share."""

from __future__ import annotations

import contextlib
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from rlcli.config.load import Resolved, agent_names, resolve
from rlcli.envs.direct import DirectEnv, DirectTask
from rlcli.envs.make import make_env
from rlcli.envs.step import StepResult
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import DependencyError, RlcliError
from rlcli.registry import TaskSource, find_task

NUM_ENVS = 8
STEPS = 200
"""Steps of a recording."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Violation of the contract: the check that found it, where, what was found, and what to do."""

    check: str
    severity: Literal["error", "warning"]
    where: str
    message: str
    hint: str

    def __str__(self) -> str:
        """One line."""
        return f"{self.severity}: {self.check}: {self.where}: {self.message}; {self.hint}"


def error_at(where: str, message: str, hint: str) -> Finding:
    """Return an error of the check that is running; the kit adds the name of the check."""
    return Finding("", "error", where, message, hint)


def warning_at(where: str, message: str, hint: str) -> Finding:
    """Return a warning of the check that is running, likewise."""
    return Finding("", "warning", where, message, hint)


class NotRunError(Exception):
    """Raised by a check that says nothing about this task, or on this machine: why."""


@dataclass(slots=True)
class Recording:
    """Step results of an environment, with copies that show whether the tensors change later."""

    env: VecEnv
    steps: list[StepResult] = field(default_factory=list)
    """As given; their tensors may have been written to since."""
    obs: list[dict[str, Tensor]] = field(default_factory=list)
    """Copies, the start's first. [group -> (num_envs, d)]"""
    late_writes: dict[str, int] = field(default_factory=dict)
    """What changed after it was given, although it may not yet -> the first step that it was given in."""
    shared: dict[str, int] = field(default_factory=dict)
    """What shares memory with its predecessor -> the first step."""
    error: Exception | None = None


class TaskUnderTest:
    """A task, as training sees it but with few environments and one engine thread."""

    def __init__(self, source: TaskSource, agent: str | None = None, overrides: Sequence[str] = ()) -> None:
        self.source = source
        self._agent, self._overrides = agent, tuple(overrides)
        # the files must hold as the user wrote them, and for playing
        resolve(source, agent=agent, overrides=overrides)
        resolve(source, agent=agent, overrides=overrides, play=True)
        self.resolved = self._resolve({})
        self.notes: dict[str, str] = {}
        """Check -> what else there is to say, besides what it found."""
        self._recording: Recording | None = None

    @property
    def is_direct(self) -> bool:
        """Whether the task is written in the direct workflow."""
        return self.source.task is not None

    @property
    def bound(self) -> float:
        """Largest action tried: the agent's bound, or 1 where it has none."""
        return (self.resolved.agent and self.resolved.agent.action_bound) or 1.0

    def env(self, *, episode_steps: int | None = None, seed: int = 0, flags: Mapping[str, Any] | None = None) -> VecEnv:
        """A new environment of the task; with `episode_steps`, with episodes of that many steps.

        `flags` are further settings, by dotted key.
        """
        settings = dict(flags or {})
        if episode_steps is not None:
            settings["episode_length_s"] = episode_steps * self.resolved.task.step_dt
        return make_env(self._resolve(settings), seed=seed)

    def recording(self) -> Recording:
        """200 steps of random actions. The first to ask gets the error that ended them, if one did."""
        if self._recording is None:
            env = self.env()
            self._recording = record(env, random_actions(env, self.bound))
            if self._recording.error is not None:
                raise self._recording.error
        return self._recording

    def place(self, error: Exception) -> str:
        """The innermost line of the task's own files that an error passed through, or the task."""
        frames = traceback.extract_tb(error.__traceback__)
        own = [f for f in frames if Path(f.filename).is_relative_to(self.source.root)]
        return f"{own[-1].filename}:{own[-1].lineno}" if own else self.source.label

    def agents(self) -> dict[str, Resolved]:
        """The task as each of its agents would train it, those left out whose trainer is not installed."""
        names = [self._agent] if self._agent else agent_names(self.resolved.layers)
        found = {}
        for name in names:
            with contextlib.suppress(DependencyError):
                overrides = self._overrides
                if name != self.resolved.agent_name:  # without those of the chosen agent's settings
                    overrides = tuple(override for override in overrides if not override.startswith("agent."))
                found[name] = resolve(self.source, agent=name, overrides=overrides)
        return found

    def _resolve(self, flags: dict[str, Any]) -> Resolved:
        small = {"scene.num_envs": NUM_ENVS, "sim.engine_threads": 1}
        return resolve(self.source, agent=self._agent, overrides=self._overrides, flags={**small, **flags})


def open_task(task: str | Path, agent: str | None, overrides: Sequence[str]) -> TaskUnderTest:
    """Find a task by its name, or by the path of its folder."""
    name = str(task.resolve()) if isinstance(task, Path) else task
    return TaskUnderTest(find_task(name), agent, overrides)


def error_text(error: Exception) -> str:
    """Return the message of an error as one line."""
    message = error.message if isinstance(error, RlcliError) else f"{type(error).__name__}: {error}"
    return " ".join(message.split())


def random_actions(env: VecEnv, bound: float, steps: int = STEPS) -> Iterator[Tensor]:
    """Uniform actions within the bound, the same ones every time."""
    generator = torch.Generator().manual_seed(0)
    for _ in range(steps):
        yield (torch.rand(env.num_envs, env.layout.action_size, generator=generator) * 2.0 - 1.0) * bound


def extreme_actions(env: VecEnv, bound: float, steps: int = STEPS) -> Iterator[Tensor]:
    """The bound with alternating sign, every 8th one held twice; half of the environments against the other half."""
    sign = torch.ones(env.num_envs, 1)
    sign[1::2] = -1.0
    for step in range(steps):
        pushed = sign * (-1.0) ** (step + step // 8) * bound
        yield pushed.expand(-1, env.layout.action_size).clone()


def record(env: VecEnv, actions: Iterator[Tensor]) -> Recording:
    """Live until the actions end or something is raised."""
    recording = Recording(env)
    try:
        given = env.reset(seed=0)
        recording.obs.append(_copy(given))
        previous = {f"observation '{group}'": value for group, value in given.items()}
        copies = _copy(previous)
        for number, action in enumerate(actions):
            before = action.clone()
            result = env.step(action)
            recording.steps.append(result)
            recording.obs.append(_copy(result.obs))
            for what, value in previous.items():
                if not bitwise_equal(value, copies[what]):
                    recording.late_writes.setdefault(what, number)
            if not bitwise_equal(action, before):
                recording.late_writes.setdefault("the action", number)
            given_now = step_outputs(result)
            for what, value in given_now.items():
                if what in previous and value.numel() and value.data_ptr() == previous[what].data_ptr():
                    recording.shared.setdefault(what, number)
            previous, copies = given_now, _copy(given_now)
    except Exception as error:
        recording.error = error
    return recording


def record_trajectory(env: VecEnv, actions: Iterator[Tensor], seed: int = 0) -> list[dict[str, Tensor]]:
    """Return copies of everything an environment returns from `reset(seed)` on, the start first."""
    life = [{f"observation '{group}'": value.clone() for group, value in env.reset(seed=seed).items()}]
    life += [_copy(step_outputs(env.step(action))) for action in actions]
    return life


def step_outputs(result: StepResult) -> dict[str, Tensor]:
    """Return all tensors of a step result by name."""
    return {
        **{f"observation '{group}'": value for group, value in result.obs.items()},
        "reward": result.reward,
        "terminated": result.terminated,
        "truncated": result.truncated,
    }


def expire_episodes(env: VecEnv, rows: list[int]) -> None:
    """Set the episode length of some environments to one step before the time limit."""
    env.episode_length_buf[rows] = env.max_episode_length - 1
    if isinstance(env, DirectEnv):
        env.task.progress_buf[rows] = env.max_episode_length - 1


def task_of(env: VecEnv) -> DirectTask:
    """The direct task inside an environment."""
    assert isinstance(env, DirectEnv)
    return env.task


def engine_state(env: VecEnv) -> dict[str, Tensor]:
    """The engine's state, one row an environment."""
    state = env.engine.state_dict()
    return {name: value for name, value in state.items() if value.dim() and len(value) == env.num_envs}


def column_names(env: VecEnv, group: str) -> list[str]:
    """Return the names of an observation group's columns, for messages."""
    names = []
    for term in env.layout.observations[group]:
        several = term.elements if len(term.elements) == term.size else tuple(str(i) for i in range(term.size))
        names += [term.name if term.size == 1 and not term.elements else f"{term.name}[{e}]" for e in several]
    return names


def observation_parts(env: VecEnv, group: str) -> list[tuple[str, slice]]:
    """Return the columns and the pictures of an observation group, with a name for messages each."""
    names, parts, start = column_names(env, group), [], 0
    for term in env.layout.observations[group]:
        end = start + term.size
        if len(term.shape) > 1:
            where = f"observations.{group}, columns {start} to {end - 1} (picture {term.name})"
            parts.append((where, slice(start, end)))
        else:
            columns = range(start, end)
            parts += [(f"observations.{group}, column {c} ({names[c]})", slice(c, c + 1)) for c in columns]
        start = end
    return parts


def bitwise_equal(left: Tensor, right: Tensor) -> bool:
    """Return whether two tensors are equal bit for bit, NaN included."""
    return left.shape == right.shape and bool(((left == right) | ((left != left) & (right != right))).all())


def _copy(values: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in values.items()}

"""Task under test: small seeded environments, recorded trajectories, and one recording that several checks share."""

from __future__ import annotations

import contextlib
import traceback
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
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
    """Violation of the contract: the check, the place, what was found, and what to do."""

    check: str
    severity: Literal["error", "warning"]
    where: str
    message: str
    hint: str

    def __str__(self) -> str:
        """Return the finding as one line."""
        return f"{self.severity}: {self.check}: {self.where}: {self.message}; {self.hint}"


error_at = partial(Finding, "", "error")
"""(where, message, hint) -> error of the running check; the kit adds the name of the check."""
warning_at = partial(Finding, "", "warning")
"""(where, message, hint) -> warning of the running check; the kit adds the name of the check."""


class NotRunError(Exception):
    """Raised by a check that does not apply to this task or this machine; the message is the reason."""


@dataclass(slots=True)
class Recording:
    """Step results of an environment, with copies that show whether the tensors change later."""

    env: VecEnv
    steps: list[StepResult] = field(default_factory=list)
    """The results themselves, not copies: the task may have changed their tensors since."""
    obs: list[dict[str, Tensor]] = field(default_factory=list)
    """Copies, beginning with the observations of the reset. [group -> (num_envs, d)]"""
    late_writes: dict[str, int] = field(default_factory=dict)
    """Name of a tensor that was changed during the next step -> number of the first such step."""
    shared: dict[str, int] = field(default_factory=dict)
    """Name of a tensor that shares memory with its predecessor -> number of the first such step."""
    error: Exception | None = None


@dataclass(frozen=True, slots=True)
class EndedEpisode:
    """Episode that ended in a step."""

    env_id: int
    length: int
    """Number of its steps."""
    terminated: bool
    truncated: bool
    causes: tuple[str, ...]
    """Names of the termination terms that ended it."""


def ended_episodes(result: StepResult) -> list[EndedEpisode]:
    """Return the episodes that ended in the last step of an environment; later its result is overwritten."""
    if result.episodes is None:
        return []
    ended = result.episodes.ended()
    episodes = []
    for row, env_id in enumerate(ended.ids.tolist()):
        flags = bool(result.terminated[env_id]), bool(result.truncated[env_id])
        causes = tuple(name for name, fired in ended.causes.items() if bool(fired[row]))
        episodes.append(EndedEpisode(env_id, int(ended.lengths[row]), *flags, causes))
    return episodes


class TaskUnderTest:
    """Task as in training, but with few environments and one engine thread."""

    def __init__(self, source: TaskSource, agent: str | None = None, overrides: Sequence[str] = ()) -> None:
        self.source = source
        self._agent, self._overrides = agent, tuple(overrides)
        # the configuration must be valid without our flags, and for playing
        resolve(source, agent=agent, overrides=overrides)
        resolve(source, agent=agent, overrides=overrides, play=True)
        self.resolved = self._resolve({})
        self.notes: dict[str, str] = {}
        """Check -> further text that is printed with its result."""
        self._recording: Recording | None = None

    @property
    def is_direct(self) -> bool:
        """Whether the task uses the direct workflow."""
        return self.source.task is not None

    @property
    def bound(self) -> float:
        """Largest action of the checks: the agent's bound, or 1 if it has none."""
        return (self.resolved.agent and self.resolved.agent.action_bound) or 1.0

    def env(self, *, episode_steps: int | None = None, seed: int = 0, flags: Mapping[str, Any] | None = None) -> VecEnv:
        """Return a new environment of the task.

        Args:
            episode_steps: length of an episode [steps]; None: the task's.
            seed: seed of the environment.
            flags: further settings by dotted key.
        """
        settings = dict(flags or {})
        if episode_steps is not None:
            settings["episode_length_s"] = episode_steps * self.resolved.task.step_dt
        return make_env(self._resolve(settings), seed=seed)

    def recording(self) -> Recording:
        """Return 200 steps of random actions; only the first call raises the error that ended them, if there is one."""
        if self._recording is None:
            env = self.env()
            self._recording = record(env, random_actions(env, self.bound))
            if self._recording.error is not None:
                raise self._recording.error
        return self._recording

    def location(self, error: Exception) -> str:
        """Return the innermost line of the task's own files in an error's traceback; else the task's name."""
        frames = traceback.extract_tb(error.__traceback__)
        own = [f for f in frames if Path(f.filename).is_relative_to(self.source.root)]
        return f"{own[-1].filename}:{own[-1].lineno}" if own else self.source.label

    def agents(self) -> dict[str, Resolved]:
        """Return the task as each of its agents trains it, without agents whose trainer is not installed."""
        names = [self._agent] if self._agent else agent_names(self.resolved.layers)
        agents = {}
        for name in names:
            with contextlib.suppress(DependencyError):
                overrides = self._overrides
                if name != self.resolved.agent_name:  # `agent.` overrides are for the selected agent
                    overrides = tuple(override for override in overrides if not override.startswith("agent."))
                agents[name] = resolve(self.source, agent=name, overrides=overrides)
        return agents

    def _resolve(self, flags: dict[str, Any]) -> Resolved:
        small = {"scene.num_envs": NUM_ENVS, "sim.engine_threads": 1}
        return resolve(self.source, agent=self._agent, overrides=self._overrides, flags={**small, **flags})


def open_task(task: str | Path, agent: str | None, overrides: Sequence[str]) -> TaskUnderTest:
    """Open a task by its name, or by the path of its folder."""
    name = str(task.resolve()) if isinstance(task, Path) else task
    return TaskUnderTest(find_task(name), agent, overrides)


def error_text(error: Exception) -> str:
    """Return the message of an error as one line."""
    message = error.message if isinstance(error, RlcliError) else f"{type(error).__name__}: {error}"
    return " ".join(message.split())


def random_actions(env: VecEnv, bound: float, steps: int = STEPS) -> Iterator[Tensor]:
    """Yield uniform actions within the bound. They have a fixed seed. (num_envs, a)"""
    generator = torch.Generator().manual_seed(0)
    for _ in range(steps):
        yield (torch.rand(env.num_envs, env.layout.action_size, generator=generator) * 2.0 - 1.0) * bound


def extreme_actions(env: VecEnv, bound: float, steps: int = STEPS) -> Iterator[Tensor]:
    """Yield actions at the bound with alternating signs; every eighth sign is repeated: + - + - + - + - - + - + ...

    Every second environment gets the opposite sign.
    """
    sign = torch.ones(env.num_envs, 1)
    sign[1::2] = -1.0
    for step in range(steps):
        action = sign * (-1.0) ** (step + step // 8) * bound
        yield action.expand(-1, env.layout.action_size).clone()


def record(env: VecEnv, actions: Iterator[Tensor]) -> Recording:
    """Step an environment until the actions end or an error is raised."""
    recording = Recording(env)
    try:
        obs = env.reset(seed=0)
        recording.obs.append(_copy(obs))
        previous = {f"observation '{group}'": value for group, value in obs.items()}
        copies = _copy(previous)
        for number, action in enumerate(actions):
            before = action.clone()
            result = env.step(action)
            recording.steps.append(result)
            recording.obs.append(_copy(result.obs))
            for name, value in previous.items():
                if not bitwise_equal(value, copies[name]):
                    recording.late_writes.setdefault(name, number)
            if not bitwise_equal(action, before):
                recording.late_writes.setdefault("the action", number)
            outputs = step_outputs(result)
            for name, value in outputs.items():
                if name in previous and value.numel() and value.data_ptr() == previous[name].data_ptr():
                    recording.shared.setdefault(name, number)
            previous, copies = outputs, _copy(outputs)
    except Exception as error:
        recording.error = error
    return recording


def record_trajectory(env: VecEnv, actions: Iterator[Tensor], seed: int = 0) -> list[dict[str, Tensor]]:
    """Return copies of all outputs of `reset(seed)` and of the following steps."""
    trajectory = [{f"observation '{group}'": value.clone() for group, value in env.reset(seed=seed).items()}]
    trajectory += [_copy(step_outputs(env.step(action))) for action in actions]
    return trajectory


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
    """Return the direct task of an environment."""
    assert isinstance(env, DirectEnv)
    return env.task


def engine_state(env: VecEnv) -> dict[str, Tensor]:
    """Return the tensors of the engine's state that have one row for each environment."""
    state = env.engine.state_dict()
    return {name: value for name, value in state.items() if value.dim() and len(value) == env.num_envs}


def column_names(env: VecEnv, group: str) -> list[str]:
    """Return the names of an observation group's columns, for messages."""
    names = []
    for term in env.layout.observations[group]:
        elements = element_names(term.elements, term.size)
        names += [term.name if term.size == 1 and not term.elements else f"{term.name}[{e}]" for e in elements]
    return names


def element_names(elements: Sequence[str], size: int) -> list[str]:
    """Return the names of a term's columns; their numbers if the term does not have one name for each."""
    return list(elements) if len(elements) == size else [str(number) for number in range(size)]


def observation_parts(env: VecEnv, group: str) -> list[tuple[str, slice]]:
    """Return (name for messages, columns) of each column and each picture of an observation group."""
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

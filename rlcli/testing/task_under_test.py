"""Class `TaskUnderTest`, the form in which checks and linter get a task: few environments, seeded, on one thread.

The class also has a recording of random actions that several checks share.
"""

from __future__ import annotations

import contextlib
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from rlcli.config.load import Resolved, agent_names, resolve
from rlcli.envs.direct import DirectEnv, DirectTask
from rlcli.envs.make import make_env
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import DependencyError, UsageError
from rlcli.registry import TaskSource, find_task
from rlcli.testing.steps import Recording, random_actions, record

NUM_ENVS = 8
"""Default number of environments of a check, and the smallest number that `--num-envs` allows."""


class TaskUnderTest:
    """Task as in training, but with few environments and one engine thread.

    The arguments are those of `check_task`. An invalid configuration raises `ConfigError`.
    """

    def __init__(
        self,
        source: TaskSource,
        agent: str | None = None,
        overrides: Sequence[str] = (),
        config: Path | None = None,
        num_envs: int = NUM_ENVS,
        seed: int = 0,
    ) -> None:
        self.source, self.num_envs, self.seed = source, num_envs, seed
        self._agent, self._overrides, self._config = agent, tuple(overrides), config
        # the configuration must be valid without the settings of the checks, and in play mode
        resolve(source, agent=agent, config_file=config, overrides=overrides)
        resolve(source, agent=agent, config_file=config, overrides=overrides, play=True)
        self.resolved = self._resolve({})
        self.notes: dict[str, str] = {}
        """Name of a check -> text that is printed with its result, such as a measured speed."""
        self._recording: Recording | None = None

    @property
    def is_direct(self) -> bool:
        """Whether the task uses the direct workflow."""
        return self.source.task is not None

    @property
    def bound(self) -> float:
        """Largest action of the checks: the agent's bound, or 1 if it has none."""
        return (self.resolved.agent and self.resolved.agent.action_bound) or 1.0

    def env(self, *, episode_steps: int | None = None, flags: Mapping[str, Any] | None = None) -> VecEnv:
        """Return a new environment of the task.

        Args:
            episode_steps: length of an episode [steps]; None: the task's.
            flags: further settings by dotted key.
        """
        settings = dict(flags or {})
        if episode_steps is not None:
            settings["episode_length_s"] = episode_steps * self.resolved.task.step_dt
        return make_env(self._resolve(settings), seed=self.seed)

    def recording(self) -> Recording:
        """Return a recording of 200 steps of random actions, which the first call makes.

        If an error ends the steps, the first call raises the error, and later calls return the steps before it.
        """
        if self._recording is None:
            env = self.env()
            self._recording = record(env, random_actions(env, self.bound))
            if self._recording.error is not None:
                raise self._recording.error
        return self._recording

    def location(self, error: Exception) -> str:
        """Return `file:line` of the innermost frame of an error's traceback in the task's own files.

        Without such a frame, return the name of the task's configuration file.
        """
        frames = traceback.extract_tb(error.__traceback__)
        own = [f for f in frames if Path(f.filename).is_relative_to(self.source.root)]
        return f"{own[-1].filename}:{own[-1].lineno}" if own else self.source.label

    def agents(self) -> dict[str, Resolved]:
        """Return the task's configuration with the changes of each agent, by the name of the agent.

        Agents whose trainer is not installed are left out.
        """
        names = [self._agent] if self._agent else agent_names(self.resolved.layers)
        agents = {}
        for name in names:
            with contextlib.suppress(DependencyError):
                overrides = self._overrides
                if name != self.resolved.agent_name:  # `agent.` overrides are for the selected agent
                    overrides = tuple(override for override in overrides if not override.startswith("agent."))
                agents[name] = resolve(self.source, agent=name, config_file=self._config, overrides=overrides)
        return agents

    def _resolve(self, flags: dict[str, Any]) -> Resolved:
        values = {"scene.num_envs": self.num_envs, "sim.engine_threads": 1, **flags}
        agent, config = self._agent, self._config
        return resolve(self.source, agent=agent, config_file=config, overrides=self._overrides, flags=values)


def open_task(
    task: str | Path, agent: str | None, overrides: Sequence[str], config: Path | None, num_envs: int, seed: int
) -> TaskUnderTest:
    """Open a task for checks or lint rules. The arguments are those of `check_task`.

    Raises:
        UsageError: for fewer than `NUM_ENVS` environments.
    """
    if num_envs < NUM_ENVS:
        raise UsageError(
            f"{num_envs} environments are too few",
            hint=f"give at least {NUM_ENVS}: some episodes end while others continue",
        )
    name = str(task.resolve()) if isinstance(task, Path) else task
    return TaskUnderTest(find_task(name), agent, overrides, config, num_envs, seed)


def expire_episodes(env: VecEnv, rows: list[int]) -> None:
    """Set the number of steps of some environments' episodes so that the next step reaches the time limit."""
    env.episode_length_buf[rows] = env.max_episode_length - 1
    if isinstance(env, DirectEnv):
        env.task.progress_buf[rows] = env.max_episode_length - 1


def task_of(env: VecEnv) -> DirectTask:
    """Return the direct task of an environment."""
    assert isinstance(env, DirectEnv)
    return env.task


def engine_state(env: VecEnv) -> dict[str, Tensor]:
    """Return copies of the engine's state, such as positions and velocities, that have a row for each environment."""
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
    """Return the names of a term's `size` columns; their indices if the term does not have one name for each column."""
    return list(elements) if len(elements) == size else [str(number) for number in range(size)]


def observation_parts(env: VecEnv, group: str) -> list[tuple[str, slice]]:
    """Return (name for messages, columns) of each column and each image of an observation group."""
    names, parts, start = column_names(env, group), [], 0
    for term in env.layout.observations[group]:
        end = start + term.size
        if len(term.shape) > 1:
            where = f"observations.{group}, columns {start} to {end - 1} (image {term.name})"
            parts.append((where, slice(start, end)))
        else:
            columns = range(start, end)
            parts += [(f"observations.{group}, column {c} ({names[c]})", slice(c, c + 1)) for c in columns]
        start = end
    return parts

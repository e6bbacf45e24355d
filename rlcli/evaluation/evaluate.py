"""Evaluation of a policy: each environment's first episodes, so that short ones do not count double."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from rlcli.envs.observers import StepObserver
from rlcli.envs.step import StepRecord, StepResult
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import ConfigError
from rlcli.managers.termination import DIVERGED
from rlcli.rl.acting import PATIENCE, Act
from rlcli.rl.confidence import mean, proportion


@dataclass(slots=True)
class Evaluation:
    """Finished episodes, one entry each, in the order in which they ended."""

    envs: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    successes: list[bool] = field(default_factory=list)
    truncated: list[bool] = field(default_factory=list)
    reward_terms: dict[str, list[float]] = field(default_factory=dict)
    causes: dict[str, list[bool]] = field(default_factory=dict)
    diverged: int = 0
    diverged_by: dict[str, int] = field(default_factory=dict)
    """Cause -> how often."""
    values: dict[str, list[float]] = field(default_factory=dict)
    """The task's own numbers -> their mean over each episode: what a direct task logs, by name, and what commands
    measure, as `command/metric`."""

    def summary(self) -> dict[str, Any]:
        """Means and shares with 95 % intervals, as plain JSON: Student's t of means, Wilson's of shares."""
        result: dict[str, Any] = {
            "episodes": len(self.returns),
            "return": mean(self.returns),
            "length": mean([float(n) for n in self.lengths]),
            "reward_terms": {name: mean(values) for name, values in self.reward_terms.items()},
            "terminations": {name: proportion(sum(v), max(1, len(v))) for name, v in self.causes.items()},
            "values": {name: _mean_of_finite(values) for name, values in self.values.items()},
            "diverged": self.diverged,
            "diverged_by": self.diverged_by,
        }
        if self.successes:
            result["success"] = proportion(sum(self.successes), len(self.successes))
        return result

    def part(self, first: int, stop: int) -> Evaluation:
        """The episodes of some environments, numbered from `first` on."""
        rows = [row for row, env in enumerate(self.envs) if first <= env < stop]
        return self._rows(rows, first)

    def in_environment_order(self) -> Evaluation:
        """Return the same episodes ordered by environment: those of equal random streams stand at equal places."""
        return self._rows(sorted(range(len(self.envs)), key=lambda row: self.envs[row]), 0)  # the sort keeps the order

    def _rows(self, rows: list[int], first: int) -> Evaluation:
        causes = {name: [fired[row] for row in rows] for name, fired in self.causes.items()}
        return Evaluation(
            [self.envs[row] - first for row in rows],
            [self.returns[row] for row in rows],
            [self.lengths[row] for row in rows],
            [self.successes[row] for row in rows] if self.successes else [],
            [self.truncated[row] for row in rows],
            {name: [values[row] for row in rows] for name, values in self.reward_terms.items()},
            causes,
            sum(causes.get(DIVERGED, [])),
            values={name: [values[row] for row in rows] for name, values in self.values.items()},
        )


def evaluate(
    env: VecEnv,
    act: Act,
    episodes: int,
    on_step: Callable[[StepResult], None] = lambda _: None,
    groups: int = 1,
) -> Evaluation:
    """Run exactly `episodes` episodes: how many each environment contributes is fixed beforehand.

    Counting the first episodes to finish anywhere would favour short ones.

    Args:
        env: the environments.
        act: what acts in them.
        episodes: of each group.
        on_step: sees every step.
        groups: as many equal parts of the environments, one after the other, run so many episodes each.

    Raises:
        ConfigError: if episodes go on and on because the task has no time-out.
    """
    size = env.num_envs // groups
    quota = torch.full((size,), episodes // size)
    quota[: episodes % size] += 1
    quota = quota.repeat(groups)
    result = Evaluation()
    before = env.causes
    obs = env.reset(seed=env.seed)["policy"]
    means = _EpisodeMeans(env)
    with torch.no_grad(), env.observers.added(means):
        while bool((quota > 0).any()):
            _require_end(env)
            step = env.step(act(obs))
            obs = step.obs["policy"]
            on_step(step)
            if step.episodes is not None:
                _add_episodes(result, step, quota, means)
        env.check()
    after = {cause: count - before.get(cause, 0) for cause, count in env.causes.items()}
    result.diverged_by = {cause: count for cause, count in after.items() if count}
    result.diverged = sum(after.values())
    return result


def _require_end(env: VecEnv) -> None:
    longest = int(env.episode_length_buf.max())
    if longest > PATIENCE * env.max_episode_length:
        message = f"an episode has lasted {longest} steps, {PATIENCE} times episode_length_s, and has not ended"
        hint = "add a termination with time_out: true"
        raise ConfigError([env.resolved.problem(("terminations",), message, hint)])


def _mean_of_finite(values: list[float]) -> dict[str, float | None]:
    """A mean with its interval; of values that are not all finite nothing is known."""
    if all(map(math.isfinite, values)):
        return mean(values)
    return {"mean": None, "std": None, "low": None, "high": None}


class _EpisodeMeans(StepObserver):
    """Adds up what a task logs, environment by environment, step by step, and gives the means of finished episodes."""

    def __init__(self, env: VecEnv) -> None:
        self._env = env
        self._sums: dict[str, Tensor] = {}
        self._steps: dict[str, Tensor] = {}

    def on_step(self, record: StepRecord) -> None:
        """Add the values of one step."""
        for name, values in self._env.step_metrics().items():
            sums = self._sums.setdefault(name, torch.zeros(self._env.num_envs, dtype=torch.float64))
            steps = self._steps.setdefault(name, torch.zeros(self._env.num_envs, dtype=torch.float64))
            sums += values.cpu()
            steps += 1.0

    def finish(self, ids: Tensor) -> dict[str, list[float]]:
        """Means over the episodes that have just ended in these environments."""
        ids, found = ids.cpu(), {}
        for name, sums in self._sums.items():
            steps = self._steps[name]
            found[name] = (sums[ids] / steps[ids].clamp(min=1.0)).tolist()
            sums[ids], steps[ids] = 0.0, 0.0
        return found


def _add_episodes(result: Evaluation, step: StepResult, quota: Tensor, means: _EpisodeMeans) -> None:
    assert step.episodes is not None
    ended = step.episodes.ended()
    values = {name: column.tolist() for name, column in ended.metrics.items()} | means.finish(ended.ids)
    for row, env in enumerate(ended.ids.tolist()):
        if quota[env] <= 0:
            continue
        quota[env] -= 1
        result.envs.append(env)
        result.returns.append(float(ended.returns[row]))
        result.lengths.append(int(ended.lengths[row]))
        result.truncated.append(bool(ended.truncated[row]))
        if ended.success is not None:
            result.successes.append(bool(ended.success[row]))
        for name, sums in ended.reward_terms.items():
            result.reward_terms.setdefault(name, []).append(float(sums[row]))
        for name, column in values.items():
            column_values = result.values.setdefault(name, [math.nan] * (len(result.returns) - 1))
            column_values.append(column[row])
        for name in ended.causes:  # `diverged` becomes one once something has
            result.causes.setdefault(name, [False] * (len(result.returns) - 1))
        for name, fired in result.causes.items():
            fired.append(name in ended.causes and bool(ended.causes[name][row]))

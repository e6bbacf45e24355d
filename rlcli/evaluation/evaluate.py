"""Evaluation of a policy over a given number of episodes, with means, rates and their confidence intervals.

Each environment runs a fixed number of episodes, so that short episodes are not favoured.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

import torch
from torch import Tensor

from rlcli.envs.environment_protocol import Environment
from rlcli.envs.observers import StepObserver
from rlcli.envs.step_result import Episodes, StepRecord, StepResult
from rlcli.managers.termination import DIVERGED
from rlcli.progress import track
from rlcli.replay.episode_from_seed import require_end
from rlcli.rl.action_functions import Act
from rlcli.rl.confidence import mean, proportion

_COLUMNS = (
    *("envs", "returns", "lengths", "truncated", "successes", "held", "condition_values"),
    *("reward_terms", "causes", "values"),
)
"""Names of the fields of `Evaluation` that have one value for each episode."""


@dataclass(slots=True)
class Evaluation:
    """Result of an evaluation. Each list has one value for each episode, in the order of the episodes' ends."""

    conditions: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Condition of success -> its bounds, as `at_least` and `at_most`."""
    envs: list[int] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    successes: list[bool] = field(default_factory=list)
    held: dict[str, list[bool]] = field(default_factory=dict)
    """Condition of success -> whether it held at the end of each episode."""
    condition_values: dict[str, list[float]] = field(default_factory=dict)
    """Condition of success with a bound -> its value in the last step of each episode."""
    truncated: list[bool] = field(default_factory=list)
    reward_terms: dict[str, list[float]] = field(default_factory=dict)
    causes: dict[str, list[bool]] = field(default_factory=dict)
    diverged: int = 0
    diverged_by: dict[str, int] = field(default_factory=dict)
    """Cause of a divergence -> number of simulations that diverged, also in episodes that are not counted."""
    values: dict[str, list[float]] = field(default_factory=dict)
    """Metric of the task -> a value for each episode: the means of a direct task's `extras` by name, the last values of
    its `episode_metrics`, and the means of commands' metrics, as `command/metric`."""

    def summary(self) -> dict[str, Any]:
        """Return the statistics of all episodes, as `rlcli eval --json` prints them.

        Means and rates have 95 % intervals: Student's t for means, Wilson's for rates.
        """
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
            result["conditions"] = {name: self._condition(name, bounds) for name, bounds in self.conditions.items()}
        return result

    def _condition(self, name: str, bounds: dict[str, Any]) -> dict[str, Any]:
        """Return the statistics of a condition of success, with its bounds.

        `held` is the share of episodes at whose end the condition held, `value` the mean of its last values.
        """
        result = {"held": proportion(sum(self.held[name]), len(self.held[name])), **bounds}
        if name in self.condition_values:
            result["value"] = _mean_of_finite(self.condition_values[name])
        return result

    def part(self, first: int, stop: int) -> Self:
        """Return the evaluation of the environments `first` to `stop` - 1, in which `first` has index 0."""
        rows = [row for row, env in enumerate(self.envs) if first <= env < stop]
        return self._rows(rows, first)

    def in_environment_order(self) -> Self:
        """Return the evaluation with its episodes ordered by environment.

        Episode i of two evaluations with the same seed then has the same random numbers in both.
        """
        # stable: keeps an environment's order
        return self._rows(sorted(range(len(self.envs)), key=lambda row: self.envs[row]), 0)

    def _rows(self, rows: list[int], first: int) -> Self:
        def take(column: Any) -> Any:
            if isinstance(column, dict):
                return {name: take(values) for name, values in column.items()}
            return [column[row] for row in rows] if column else []

        taken = replace(self, **{name: take(getattr(self, name)) for name in _COLUMNS}, diverged_by={})
        taken.envs = [env - first for env in taken.envs]
        taken.diverged = sum(taken.causes.get(DIVERGED, []))
        return taken


def evaluate(
    env: Environment,
    act: Act,
    episodes: int,
    on_step: Callable[[StepResult], None] = lambda _: None,
    groups: int = 1,
) -> Evaluation:
    """Run exactly `episodes` episodes in each group of environments with a policy, and return their results.

    Each environment runs a fixed number of episodes. Counting the first episodes that finish in any environment would
    favour short episodes.

    Args:
        env: the environments.
        act: the policy, a function from observations (num_envs, d) to actions (num_envs, a).
        episodes: number of episodes in each group.
        on_step: called with the result of every step.
        groups: number of equal, consecutive parts of the environments, for `Evaluation.part`.

    Raises:
        ConfigError: if an episode does not end because the task has no time-out.
    """
    size = env.num_envs // groups
    quota = torch.full((size,), episodes // size)
    quota[: episodes % size] += 1
    quota = quota.repeat(groups)
    keys = {"at_least", "at_most"}
    success = {name: config for name, config in env.config.success.items() if config is not None}
    result = Evaluation({name: each.model_dump(include=keys, exclude_none=True) for name, each in success.items()})
    before = env.causes
    obs, steps = env.reset(seed=env.seed)["policy"], 0
    longest = env.max_episode_length * -(-episodes // size)
    observed, counted = env.observers.added(_EpisodeMeans(env)), track("episodes", episodes * groups)
    with torch.no_grad(), observed as means, counted as work:
        while bool((quota > 0).any()):
            require_end(env, int(env.episode_length_buf.max()))
            step = env.step(act(obs))
            obs = step.obs["policy"]
            on_step(step)
            if step.episodes is not None:
                ended = step.episodes.ended()
                logged = {name: values.cpu()[ended.ids.cpu()].tolist() for name, values in env.reset_metrics().items()}
                _add_episodes(result, ended, quota, means.finish(ended.ids) | logged)
            steps += 1
            work.what = f"step {steps:,} of at most {longest:,}, episodes"
            work.update(len(result.returns), steps / longest)  # several episodes may end in the same step
        env.check()
    after = {cause: count - before.get(cause, 0) for cause, count in env.causes.items()}
    result.diverged_by = {cause: count for cause, count in after.items() if count}
    result.diverged = sum(after.values())
    return result


def _mean_of_finite(values: list[float]) -> dict[str, float | None]:
    """Return `mean`, `std`, and the ends `low` and `high` of the 95 % interval; all None if a value is not finite."""
    if all(map(math.isfinite, values)):
        return mean(values)
    return {"mean": None, "std": None, "low": None, "high": None}


class _EpisodeMeans(StepObserver):
    """Observer that computes the mean of each of a task's metrics over every finished episode."""

    def __init__(self, env: Environment) -> None:
        self._env = env
        self._sums: dict[str, Tensor] = {}
        self._steps: dict[str, Tensor] = {}

    def on_step(self, record: StepRecord) -> None:
        """Add the metrics of one step."""
        for name, values in self._env.step_metrics().items():
            sums = self._sums.setdefault(name, torch.zeros(self._env.num_envs, dtype=torch.float64))
            steps = self._steps.setdefault(name, torch.zeros(self._env.num_envs, dtype=torch.float64))
            sums += values.cpu()
            steps += 1.0

    def finish(self, ids: Tensor) -> dict[str, list[float]]:
        """Return the mean of each metric over the episodes that have just ended in the environments `ids`, by metric.

        The sums of these environments are set to 0 for their next episodes.
        """
        ids, found = ids.cpu(), {}
        for name, sums in self._sums.items():
            steps = self._steps[name]
            found[name] = (sums[ids] / steps[ids].clamp(min=1.0)).tolist()
            sums[ids], steps[ids] = 0.0, 0.0
        return found


def _add_episodes(result: Evaluation, ended: Episodes, quota: Tensor, logged: Mapping[str, list[float]]) -> None:
    """Add the episodes that have just ended to a result; skip environments that have run enough episodes.

    Args:
        result: the evaluation.
        ended: the episodes.
        quota: number of episodes that each environment must still run; reduced here. (num_envs,)
        logged: metric of the task -> its value for each of the episodes.
    """
    values = {name: column.tolist() for name, column in ended.metrics.items()} | dict(logged)
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
        for name, flags in ended.conditions.items():
            result.held.setdefault(name, []).append(bool(flags[row]))
        for name, numbers in ended.condition_values.items():
            result.condition_values.setdefault(name, []).append(float(numbers[row]))
        for name, sums in ended.reward_terms.items():
            result.reward_terms.setdefault(name, []).append(float(sums[row]))
        for name, column in values.items():
            column_values = result.values.setdefault(name, [math.nan] * (len(result.returns) - 1))
            column_values.append(column[row])
        for name in ended.causes:  # `diverged` becomes a cause at the first divergence
            result.causes.setdefault(name, [False] * (len(result.returns) - 1))
        for name, fired in result.causes.items():
            fired.append(name in ended.causes and bool(ended.causes[name][row]))

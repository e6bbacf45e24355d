"""Stress test: evaluation of a policy in many variants of its task, such as other masses or delays.

Episodes draw the same random numbers in each variant. `rlcli stress` prints the result.
"""

import contextlib
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from rlcli.config.load import Resolved
from rlcli.envs.make import make_env
from rlcli.envs.vec_env import VecEnv
from rlcli.evaluation.evaluate import Evaluation, evaluate
from rlcli.evaluation.limits import Limit
from rlcli.evaluation.perturbations import Perturbations
from rlcli.evaluation.session import MAX_ENVS, PolicyInTask, make_actor, one_each
from rlcli.evaluation.stress_parameters import Point, Sweep, by_name, describe_point, grid
from rlcli.progress import tracked
from rlcli.random import derive
from rlcli.rl.action_functions import Act
from rlcli.rl.rng import seed_generators

_log = logging.getLogger(__name__)

_NEAR = 0.25
"""Standard deviation of the random points near the worst variant, as a fraction of each parameter's range."""

Actor = Callable[[VecEnv], Act]
"""Function from an environment to a policy's action function in it (`session.make_actor`)."""
Summary = dict[str, Any]
"""Summary of an evaluation (`Evaluation.summary`)."""


@dataclass(frozen=True, slots=True)
class StressResult:
    """Result of a stress test: the summary of the evaluation of every variant of the task."""

    sweeps: Sequence[Sweep]
    nominal: Summary
    """Summary of the unchanged task."""
    grid: dict[Point, Summary]
    """Summary of every combination of the sweeps' values."""
    searched: dict[Point, Summary]
    """Summary of each point that the search for a worse case evaluated."""
    reference: dict[Point | None, Summary]
    """Summaries of the reference policy; the key None is the unchanged task. Empty without a reference."""
    num_envs: int

    @property
    def metric(self) -> str:
        """The metric that is compared: success, or return for a task without a success condition."""
        return "success" if "success" in self.nominal else "return"

    @property
    def variants(self) -> dict[Point, Summary]:
        """Summaries of all variants, of the grid and of the search, by the values of the parameters."""
        return {**self.grid, **self.searched}

    @property
    def worst(self) -> Point:
        """Values of the parameters in the variant with the lowest success rate, or else the lowest return."""
        return min(self.variants, key=lambda point: score(self.variants[point]))

    def failures(self, limits: Sequence[Limit]) -> list[str]:
        """Return a sentence for each minimum that a variant of the task misses, with the worst variant's values."""
        found = []
        for limit in limits:
            values = {point: limit.value_in(summary) for point, summary in self.variants.items()}
            worst = min(values, key=lambda point: -math.inf if (value := values[point]) is None else value)
            failure = limit.failure(self.variants[worst])
            if failure is not None:
                found.append(f"at {describe_point(self.sweeps, worst)}: {failure}")
        return found

    def record(self, against: str | None) -> dict[str, Any]:
        """Return the result as data for JSON.

        Args:
            against: kind of the reference policy (lqr, zero, random); None: there is no reference policy.
        """
        worst = self.worst
        reference = {point: summary for point, summary in self.reference.items() if point is not None}
        return {
            "metric": self.metric,
            "num_envs": self.num_envs,
            "sweeps": [
                {"name": s.name, "unit": s.unit, "absolute": s.neutral != 1.0, "values": s.values} for s in self.sweeps
            ],
            "nominal": self.nominal,
            "points": self._points(self.grid),
            "searched": self._points(self.searched),
            "worst": {
                "at": by_name(self.sweeps, worst),
                "found": "search" if worst in self.searched else "grid",
                **self.variants[worst],
            },
            "against": None
            if not self.reference
            else {"policy": against, "nominal": self.reference[None], "points": self._points(reference)},
        }

    def _points(self, summaries: dict[Point, Summary]) -> list[dict[str, Any]]:
        return [{"at": by_name(self.sweeps, point), **summary} for point, summary in summaries.items()]


def stress(
    policy: PolicyInTask,
    sweeps: Sequence[Sweep],
    episodes: int,
    *,
    worst: int = 0,
    reference: PolicyInTask | None = None,
) -> StressResult:
    """Evaluate a policy in its unchanged task and in many variants of it.

    The variants are all combinations of the sweeps' values (the grid), and random ones, half of them near the worst
    variant of the grid.

    Args:
        policy: the policy.
        sweeps: the parameters that are varied, with their values.
        episodes: number of episodes in each variant.
        worst: number of random variants that are evaluated to find a worse one; 0: none.
        reference: a policy that is evaluated in the unchanged task and in the variants of `sweeps`; None: none.

    Raises:
        UsageError: if the task lacks a parameter.
    """
    task = one_each(policy.resolved, episodes)
    variants = grid(sweeps)

    def run(policy_to_run: PolicyInTask, points: Sequence[Point | None]) -> list[Summary]:
        found = run_points(task, make_actor(policy_to_run), sweeps, points, episodes, policy.seed)
        return [evaluation.summary() for evaluation in found]

    _log.info(f"{len(variants) + 1} variants, {episodes} episodes in each, seed {policy.seed}")
    points: list[Point | None] = [None, *variants]
    nominal, *summaries = run(policy, points)
    compared = dict(zip(points, run(reference, points), strict=True)) if reference is not None else {}
    found = dict(zip(variants, summaries, strict=True))
    center = min(found, key=lambda point: score(found[point]))
    further = [point for point in search(sweeps, center, worst, policy.seed) if point not in found] if worst else []
    searched = dict(zip(further, run(policy, further), strict=True)) if further else {}
    return StressResult(sweeps, nominal, found, searched, compared, task.task.scene.num_envs)


def run_points(
    resolved: Resolved,
    actor: Actor,
    sweeps: Sequence[Sweep],
    points: Sequence[Point | None],
    episodes: int,
    seed: int,
) -> list[Evaluation]:
    """Evaluate a policy in variants of a task, each in as many environments as the task has.

    Environment i draws the same random numbers in every variant, and in `rlcli eval` with the same seed.

    Args:
        resolved: the task.
        actor: the policy.
        sweeps: the parameters that are varied.
        points: their values in each variant; None: the unchanged task.
        episodes: number of episodes in each variant.
        seed: seed of the evaluation.

    Raises:
        UsageError: if the task lacks a parameter.
    """
    torch.set_num_threads(1)
    size = resolved.task.scene.num_envs
    at_once = max(1, MAX_ENVS // size)
    results: list[Evaluation] = []
    starts = range(0, len(points), at_once)
    for start in starts if len(starts) == 1 else tracked(starts, "batches of variants", len(starts)):
        batch = points[start : start + at_once]
        seed_generators(derive(seed, "task"))  # some tasks draw from torch's, numpy's or Python's generator
        batched, env_seed = resolved.with_num_envs(size * len(batch)), derive(seed, "evaluation")
        with contextlib.closing(make_env(batched, seed=env_seed, shared_streams=size)) as env:
            act = actor(env)
            if sweeps:
                unchanged = (math.nan,) * len(sweeps)
                values = torch.tensor([point or unchanged for point in batch], dtype=torch.float64)
                act = Perturbations(env, sweeps, values.repeat_interleave(size, dim=0)).around(act)
            found = evaluate(env, act, episodes, groups=len(batch))
        parts = (found.part(first, first + size) for first in range(0, size * len(batch), size))
        results += [part.in_environment_order() for part in parts]
    return results


def search(sweeps: Sequence[Sweep], center: Point, count: int, seed: int) -> list[Point]:
    """Return at most `count` different random points between the lowest and highest values of the sweeps.

    Half of the points are near the point `center`, the others are uniformly distributed.
    """
    generator = np.random.default_rng(derive(seed, "stress"))
    middle = np.array([sweep.share(value) for sweep, value in zip(sweeps, center, strict=True)])
    near = middle + _NEAR * generator.standard_normal(((count + 1) // 2, len(sweeps)))
    shares = np.concatenate([near.clip(0.0, 1.0), generator.random((count // 2, len(sweeps)))])
    return list(dict.fromkeys(tuple(s.between(float(x)) for s, x in zip(sweeps, row, strict=True)) for row in shares))


def score(summary: Summary) -> tuple[float, float]:
    """Return the sort key of a variant, (success rate, mean return), from its summary; the worst variant comes first.

    Without conditions of success the success rate counts as 0.
    """
    return summary["success"]["rate"] if "success" in summary else 0.0, summary["return"]["mean"]

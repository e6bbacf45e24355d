"""How far a policy carries: it is evaluated in many variants of its task at once, in the same episodes in each."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from rlcli.config.dump import given
from rlcli.config.load import Resolved
from rlcli.envs.vec_env import VecEnv, make_env
from rlcli.random import derive
from rlcli.rl.perturbations import Perturbations
from rlcli.rl.rng import seed_generators
from rlcli.rl.rollout import Act, Evaluation, evaluate
from rlcli.rl.sweeps import Point, Sweep

MOST_ENVS = 8192
"""Environments at a time; more are run in several batches."""
_NEAR = 0.25
"""Spread of a local search, as a share of the box's edges."""

Actor = Callable[[VecEnv], Act]
"""Puts a policy into an environment."""


def run_points(
    resolved: Resolved,
    actor: Actor,
    sweeps: Sequence[Sweep],
    points: Sequence[Point | None],
    episodes: int,
    seed: int,
) -> list[Evaluation]:
    """Evaluate in the variants of a task, each in as many environments as the task has.

    Environment i of every variant lives the same life, that of environment i in `rlcli eval` with the same seed.

    Args:
        resolved: the task.
        actor: the policy.
        sweeps: what is varied.
        points: the values; None: the task as it is.
        episodes: of each variant.
        seed: of the evaluation.

    Raises:
        UsageError: for a parameter that the task does not have.
    """
    size = resolved.task.scene.num_envs
    batch = max(1, MOST_ENVS // size)
    results: list[Evaluation] = []
    for start in range(0, len(points), batch):
        results += _run(resolved, actor, sweeps, points[start : start + batch], episodes, seed)
    return results


def search(sweeps: Sequence[Sweep], around: Point, count: int, seed: int) -> list[Point]:
    """Further points of the box that the sweeps span: half of them about a point, the others anywhere."""
    generator = np.random.default_rng(derive(seed, "stress"))
    middle = np.array([sweep.share(value) for sweep, value in zip(sweeps, around, strict=True)])
    near = middle + _NEAR * generator.standard_normal(((count + 1) // 2, len(sweeps)))
    shares = np.concatenate([near.clip(0.0, 1.0), generator.random((count // 2, len(sweeps)))])
    return list(dict.fromkeys(tuple(s.between(float(x)) for s, x in zip(sweeps, row, strict=True)) for row in shares))


def score(summary: dict[str, Any]) -> tuple[float, float]:
    """What makes a variant worse than another: less success, then less return."""
    return summary["success"]["rate"] if "success" in summary else 0.0, summary["return"]["mean"]


def _run(
    resolved: Resolved,
    actor: Actor,
    sweeps: Sequence[Sweep],
    points: Sequence[Point | None],
    episodes: int,
    seed: int,
) -> list[Evaluation]:
    torch.set_num_threads(1)
    size = resolved.task.scene.num_envs
    seed_generators(derive(seed, "task"))  # some tasks draw from them
    env = make_env(with_envs(resolved, size * len(points)), seed=derive(seed, "evaluation"), lives=size)
    try:
        act = actor(env)
        if sweeps:
            as_it_is = (math.nan,) * len(sweeps)
            values = torch.tensor([as_it_is if point is None else point for point in points], dtype=torch.float64)
            act = Perturbations(env, sweeps, values.repeat_interleave(size, dim=0)).around(act)
        found = evaluate(env, act, episodes, groups=len(points))
    finally:
        env.close()
    return [found.part(number * size, (number + 1) * size).by_life() for number in range(len(points))]


def one_each(resolved: Resolved, episodes: int) -> Resolved:
    """The same task with an environment for each episode, if the user has not said how many there are."""
    return resolved if "scene.num_envs" in given(resolved) else with_envs(resolved, min(episodes, MOST_ENVS))


def with_envs(resolved: Resolved, count: int) -> Resolved:
    """The same task in so many environments."""
    scene = resolved.task.scene.model_copy(update={"num_envs": count})
    return replace(resolved, task=resolved.task.model_copy(update={"scene": scene}))

"""Comparison of several policies in the same episodes of one task, for `rlcli eval --compare RUN1 RUN2 ...`.

Differences are computed episode by episode, so that they do not contain the randomness of start states.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from rlcli.config.layers import leaves
from rlcli.config.messages import dotted
from rlcli.errors import ConfigError, Problem, UsageError, listing
from rlcli.evaluation.session import POLICIES, PolicyInTask, PolicyRequest, baseline, find_policy, make_actor
from rlcli.progress import tracked
from rlcli.safe_text import shorten

if TYPE_CHECKING:
    from rlcli.config.load import Resolved
    from rlcli.evaluation.evaluate import Evaluation
    from rlcli.registry import TaskSource

METRICS = ("success", "return", "length")
_WITHOUT_EFFECT = (
    ("scene", "num_envs"),
    ("scene", "workers"),
    ("sim", "engine_threads"),
    ("viewer",),
    ("play",),
    ("agents",),
    ("summary",),
)
"""Settings in which the compared tasks may differ, because these settings do not affect episodes."""
_MISSING = "not set"
"""Text for the value of a setting that a task does not have."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """Result of `compare`: the evaluations of several policies in the same episodes, and their differences."""

    names: list[str]
    policies: list[PolicyInTask]
    summaries: list[dict[str, Any]]
    pairs: list[dict[str, Any]]
    """One entry for each policy but the first: metric -> statistics of the pair (first policy, this policy).

    The statistics are the mean difference (first - this policy) over the same episodes, and the probability that the
    first policy has the higher value in a random episode.
    """
    num_envs: int

    def record(self) -> dict[str, Any]:
        """Return the comparison as data for JSON (`rlcli eval --compare ... --json`)."""
        rows = zip(self.names, self.policies, self.summaries, strict=True)
        return {
            "compare": self.names,
            "task": self.policies[0].resolved.source.name,
            "seed": self.policies[0].seed,
            "num_envs": self.num_envs,
            "stochastic": self.policies[0].stochastic,
            "policies": [
                {
                    "name": name,
                    "policy": policy.kind,
                    "checkpoint": str(policy.checkpoint) if policy.checkpoint else None,
                    **summary,
                }
                for name, policy, summary in rows
            ],
            "comparisons": [
                {"left": self.names[0], "right": name, **pair}
                for name, pair in zip(self.names[1:], self.pairs, strict=True)
            ],
        }


def find_policies(names: Sequence[str], request: PolicyRequest) -> list[PolicyInTask]:
    """Find the policies to compare. Policies without a run (zero, random, lqr) act in the task of the first run.

    Args:
        names: for each policy a run or checkpoint, or `shipped`, `zero`, `random` or `lqr`.
        request: the other settings, such as overrides and seed, the same for all policies.

    Raises:
        UsageError: for fewer than two policies, if no policy belongs to a run, or if the tasks have different names.
        ConfigError: with every setting in which the tasks differ.
    """
    from rlcli.runs.policy_ref import SHIPPED

    without_run = [name for name in names if name in POLICIES and name != "trained"]
    usage = "rlcli eval --compare RUN1 RUN2 [...]; shipped, lqr, zero and random may follow a run"
    if len(names) < 2:
        raise UsageError(f"--compare needs at least two policies, found: {listing(names)}", hint=usage)
    if len(without_run) == len(names):
        raise UsageError("--compare needs at least one run; all policies are evaluated in the run's task", hint=usage)
    found: dict[str, PolicyInTask] = {}
    # `shipped` comes last: it is searched in the task of the runs
    for name in sorted(dict.fromkeys(names), key=SHIPPED.__eq__):
        if name not in without_run:
            task = next(iter(found.values())).resolved.source.name if name == SHIPPED and found else None
            found[name] = find_policy(replace(request, task=task, checkpoint=name))
    first = next(found[name] for name in names if name in found)
    policies = [baseline(first, name) if name in without_run else found[name] for name in names]
    for name, policy in zip(names[1:], policies[1:], strict=True):
        _require_same_task(names[0], policies[0], name, policy)
    return policies


def compare(names: Sequence[str], policies: Sequence[PolicyInTask], episodes: int) -> Comparison:
    """Evaluate the policies in the same episodes, and compare the first policy with each other one.

    Args:
        names: the names of the policies that were given to `find_policies`.
        policies: the policies, from `find_policies`, in the same order.
        episodes: number of episodes of each policy.
    """
    from rlcli.evaluation.session import one_each
    from rlcli.evaluation.stress import run_points

    first = policies[0]
    task = one_each(first.resolved, episodes)
    found = [
        run_points(task, make_actor(policy), [], [None], episodes, first.seed)[0]
        for policy in tracked(policies, "policies", len(policies))
    ]
    return Comparison(
        list(names),
        list(policies),
        [evaluation.summary() for evaluation in found],
        [_compare_pair(found[0], other) for other in found[1:]],
        task.task.scene.num_envs,
    )


def _require_same_task(name: str, first: PolicyInTask, other_name: str, other: PolicyInTask) -> None:
    """Check that two policies act in the same task.

    Raises:
        UsageError: if the tasks have different names, or come from different packages.
        ConfigError: with every setting that differs.
    """
    ours, theirs = first.resolved.source, other.resolved.source
    if (ours.distribution, ours.name) != (theirs.distribution, theirs.name):
        tasks = [source.name if ours.name != theirs.name else _name_and_origin(source) for source in (ours, theirs)]
        raise UsageError(f"compare policies of one task: {name} is for {tasks[0]}, {other_name} for {tasks[1]}")
    left, right = _settings(first.resolved), _settings(other.resolved)
    problems = []
    for path in sorted({*left, *right}):
        ours, theirs = left.get(path, _MISSING), right.get(path, _MISSING)
        if ours != theirs:
            message = f"the value is {shorten(theirs, 60)} here, but {shorten(ours, 60)} in {name}"
            problems.append(Problem(other_name, path, message))
    if problems:
        hint = "add KEY.PATH=VALUE to use the same value for both"
        raise ConfigError([*problems[:-1], replace(problems[-1], hint=hint)])


def _name_and_origin(source: TaskSource) -> str:
    """Return the name of a task with its distribution or folder: two tasks may have the same name."""
    return f"{source.name} ({source.distribution or source.root})"


def _settings(resolved: Resolved) -> dict[str, Any]:
    """Return the values in a task's configuration that affect episodes, by dotted key."""
    from rlcli.config.dump import to_data

    values = leaves(to_data(resolved))
    return {
        dotted(path): value
        for path, value in values
        if not any(path[: len(prefix)] == prefix for prefix in _WITHOUT_EFFECT)
    }


def _compare_pair(left: Evaluation, right: Evaluation) -> dict[str, Any]:
    """Compare two evaluations metric by metric: difference (left - right), and probability that `left` is higher.

    Episode i of both evaluations must have the same random numbers.
    """
    from rlcli.rl.confidence import difference, improvement

    found = {}
    for metric, field in zip(METRICS, ("successes", "returns", "lengths"), strict=True):
        ours, theirs = ([float(value) for value in getattr(side, field)] for side in (left, right))
        if ours:
            found[metric] = {"difference": difference(ours, theirs), "improvement": improvement(ours, theirs)}
    return found

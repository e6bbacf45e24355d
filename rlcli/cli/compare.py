"""`rlcli eval --compare RUN1 RUN2 ...`: policies in the same episodes of one task, and how sure the better one is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.cli.console import console

if TYPE_CHECKING:
    from rlcli.cli.session import Subject
    from rlcli.rl.rollout import Evaluation

_METRICS = ("success", "return", "length")
_NOT_THE_TASK = (("scene", "num_envs"), ("sim", "engine_threads"), ("viewer",), ("play",), ("agents",), ("summary",))
"""What may differ: it changes no episode."""


def compare(
    words: list[str],
    *,
    limits: dict[str, float],
    ceilings: dict[str, float],
    episodes: int,
    stochastic: bool,
    num_envs: int | None,
    seed: int,
    config: Path | None,
    runs_dir: Path | None,
) -> list[str]:
    """Run and show; what the first policy falls short of, in words.

    Args:
        words: what stood there without a dash: policies, and KEY.PATH=VALUE for all of them.
        limits: of --fail-under, for the first policy.
        ceilings: of --fail-over, likewise.
        episodes: of each policy.
        stochastic: sample actions.
        num_envs: environments; None: one an episode.
        seed: of the episodes.
        config: YAML merged over every run's task.
        runs_dir: the folder of runs.

    Raises:
        UsageError: for fewer than two policies.
        ConfigError: for tasks that differ.
    """
    from rlcli.cli.eval import require_success, verdict
    from rlcli.cli.session import actor

    names = [word for word in words if "=" not in word]
    overrides = [word for word in words if "=" in word]
    subjects = _find(names, overrides, stochastic, num_envs, seed, config, runs_dir)
    for name, subject in zip(names[1:], subjects[1:], strict=True):
        _require_same(names[0], subjects[0], name, subject)
    resolved = subjects[0].resolved
    require_success(resolved, limits | ceilings)
    from rlcli.rl.stress import one_each, run_points

    task = one_each(resolved, episodes)
    found = [run_points(task, actor(subject), [], [None], episodes, seed)[0] for subject in subjects]
    summaries = [evaluation.summary() for evaluation in found]
    rows = [_compared(found[0], other) for other in found[1:]]
    failures = verdict(summaries[0], limits, ceilings)
    labels = _labels(names)
    config_of = resolved.task
    console.data(
        f"{resolved.source.name}: {episodes} episodes each, seed {seed}, the same ones; {config_of.max_episode_length}"
        f" steps of {config_of.step_dt:.6g} s at most{''.join(f', {word}' for word in overrides)}"
    )
    _show(labels, summaries, rows)
    console.document(
        "eval",
        compare=names,
        task=resolved.source.name,
        overrides=overrides,
        seed=seed,
        num_envs=task.task.scene.num_envs,
        stochastic=stochastic,
        policies=[
            {
                "name": name,
                "policy": subject.policy,
                "checkpoint": str(subject.checkpoint) if subject.checkpoint else None,
                **summary,
            }
            for name, subject, summary in zip(names, subjects, summaries, strict=True)
        ],
        comparisons=[{"left": names[0], "right": name, **row} for name, row in zip(names[1:], rows, strict=True)],
        passed=not failures,
        failures=failures,
    )
    return failures


def _find(
    names: list[str],
    overrides: list[str],
    stochastic: bool,
    num_envs: int | None,
    seed: int,
    config: Path | None,
    runs_dir: Path | None,
) -> list[Subject]:
    """A subject for each name: those of policies that need no checkpoint play the first run's task."""
    from rlcli.cli.session import POLICIES, baseline, find_subject
    from rlcli.errors import UsageError
    from rlcli.rl.choice import SHIPPED

    plain = [name for name in names if name in POLICIES and name != "trained"]
    if len(names) < 2 or len(plain) == len(names):
        raise UsageError(
            " ".join(["--compare", *names]) + ": with what?"
            if len(names) < 2
            else "none of these is a run, so that there is no task",
            hint="rlcli eval --compare RUN1 RUN2 [...]; beside a run also shipped, lqr, zero or random",
        )
    runs: dict[str, Subject] = {}
    for name in sorted(dict.fromkeys(names), key=SHIPPED.__eq__):  # last: what a task ships, the others' task
        if name in plain:
            continue
        task = next(iter(runs.values())).resolved.source.name if name == SHIPPED and runs else None
        runs[name] = find_subject(
            task,
            overrides,
            checkpoint=name,
            policy="trained",
            stochastic=stochastic,
            num_envs=num_envs,
            seed=seed,
            config=config,
            runs_dir=runs_dir,
        )
    first = next(runs[name] for name in names if name in runs)
    return [baseline(first, name) if name in plain else runs[name] for name in names]


def _require_same(name: str, first: Subject, other_name: str, other: Subject) -> None:
    """Policies are compared in one task alone.

    Raises:
        ConfigError: with everything that differs.
    """
    from rlcli.errors import ConfigError, Problem, UsageError

    ours, theirs = first.resolved.source, other.resolved.source
    if (ours.distribution, ours.name) != (theirs.distribution, theirs.name):
        raise UsageError(f"{name} is of the task {ours.name}, and {other_name} of {theirs.name}")
    one, two = (dict(_leaves(_task(subject.resolved), ())) for subject in (first, other))
    absent = "nothing"
    problems = [
        Problem(other_name, path, f"{_short(two.get(path, absent))}, and in {name} {_short(one.get(path, absent))}")
        for path in sorted({*one, *two})
        if one.get(path, absent) != two.get(path, absent)
    ]
    if problems:
        hint = "KEY.PATH=VALUE makes both alike, where that is what you want to compare them in"
        problems[-1] = Problem(problems[-1].where, problems[-1].path, problems[-1].message, hint)
        raise ConfigError(problems)


def _task(resolved: Any) -> dict[str, Any]:
    """The task as data, without what changes no episode."""
    from rlcli.config.dump import to_data

    data = to_data(resolved)
    for path in _NOT_THE_TASK:
        *above, last = path
        inner = data
        for key in above:
            inner = inner[key]
        inner.pop(last, None)
    return data


def _leaves(value: Any, path: tuple[str, ...]) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict) and value:
        for key, item in value.items():
            yield from _leaves(item, (*path, str(key)))
    else:
        yield ".".join(path), value


def _short(value: Any) -> str:
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _compared(left: Evaluation, right: Evaluation) -> dict[str, Any]:
    """Paired differences and probabilities of improvement; equal places are equal lives."""
    from rlcli.rl.intervals import difference, improvement

    found = {}
    for metric in _METRICS:
        one, other = _values(left, metric), _values(right, metric)
        if one:
            found[metric] = {"difference": difference(one, other), "improvement": improvement(one, other)}
    return found


def _values(evaluation: Evaluation, metric: str) -> list[float]:
    values: dict[str, Any] = {
        "success": evaluation.successes,
        "return": evaluation.returns,
        "length": evaluation.lengths,
    }
    return [float(value) for value in values[metric]]


def _labels(names: list[str]) -> list[str]:
    """Names of columns: the last part of a path where that tells them apart."""
    short = [Path(name).name or name for name in names]
    return short if len(set(short)) == len(set(names)) else names


def _show(labels: list[str], summaries: list[dict[str, Any]], rows: list[dict[str, Any]]) -> None:
    from rlcli.cli.eval import interval

    table = []
    for metric in _METRICS:
        if metric in summaries[0]:
            table += [
                [metric, label, f"{_middle(summary[metric]):.4f}", interval(summary[metric])]
                for label, summary in zip(labels, summaries, strict=True)
            ]
    console.table(["", "POLICY", "MEAN", "95 % INTERVAL"], table)
    console.data("")
    pairs = []
    for label, row in zip(labels[1:], rows, strict=True):
        for metric, said in row.items():
            gap, better = said["difference"], said["improvement"]
            pairs.append(
                [
                    f"{metric}: {labels[0]} - {label}",
                    f"{gap['mean']:+.4f}",
                    interval(gap),
                    f"{better['probability']:.3f}",
                    interval(better),
                ]
            )
    console.table(["PAIRED", "DIFFERENCE", "95 % INTERVAL", "P(IMPROVEMENT)", "95 % INTERVAL"], pairs)


def _middle(value: dict[str, Any]) -> float:
    return value["rate"] if "rate" in value else value["mean"]

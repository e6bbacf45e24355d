"""Runs the checks one after the other; one that raises is a finding of its own, and the others still run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from rlcli.errors import (
    ConfigError,
    DependencyError,
    DeviceError,
    MachineError,
    ShapeError,
    TaskError,
    require_known,
)
from rlcli.testing import episode_checks, portability_checks, value_checks
from rlcli.testing.task_under_test import Finding, NotRunError, TaskUnderTest, error_text, open_task

Check = Callable[[TaskUnderTest], Iterable[Finding]]
OnCheck = Callable[[str, "list[Finding] | None"], None]
OnNote = Callable[[str, str], None]

CHECKS: dict[str, Check] = {
    "names": value_checks.names,
    "yaml-round-trip": value_checks.yaml_round_trip,
    "finite": value_checks.finite,
    "shapes": value_checks.shapes,
    "dtypes": value_checks.dtypes,
    "random-actions": value_checks.random_actions_stay_stable,
    "extreme-actions": value_checks.extreme_actions_stay_stable,
    "same-seed": episode_checks.same_seed,
    "start-states": episode_checks.start_states,
    "constant-columns": value_checks.constant_columns,
    "aliasing": value_checks.aliasing,
    "partial-reset": episode_checks.partial_reset,
    "final-observations": episode_checks.final_observations,
    "truncation": episode_checks.truncation,
    "termination": episode_checks.termination,
    "repeated-observation": episode_checks.repeated_observation,
    "observation-after-reset": episode_checks.observation_after_reset,
    "back-fill": episode_checks.back_fill,
    "checkpoint": portability_checks.checkpoint,
    "layout": portability_checks.layout,
    "policy": portability_checks.policy,
    "threads": portability_checks.threads,
    "num-envs": portability_checks.num_envs,
    "speed": portability_checks.speed,
    "engines": portability_checks.engines,
    "captured": portability_checks.captured,
}
"""Name -> check, in the order in which they run. The first line of a check's docstring says what it demands."""

_DIRECT_ONLY = ("observation-after-reset",)


def check_task(
    task: str | Path,
    *,
    agent: str | None = None,
    overrides: Sequence[str] = (),
    only: Sequence[str] = (),
    on_check: OnCheck = lambda name, findings: None,
    on_note: OnNote = lambda name, text: None,
) -> list[Finding]:
    """Check a task against the contract, in a few seconds.

    Args:
        task: a name from `list-tasks`, or a folder with a `task.yaml`.
        agent: whose patch of the task and action bound hold; None takes the default agent.
        overrides: `key.path=value`, as on the command line.
        only: names of checks to run; all if empty.
        on_check: called after each check with its name and findings; with None for a check that was not run.
        on_note: called after a check with its name and what else it has to say: why it was not run, what it measured.

    Returns:
        What the task does not keep; empty for a task that is in order.

    Raises:
        UsageError: for a check that does not exist.
        ConfigError: if the files are not valid; `rlcli validate` says the same.
        TaskError: if there is no such task, or it cannot be imported.
    """
    for name in only:
        require_known(name, list(CHECKS), "check", "checks")
    subject = open_task(task, agent, overrides)
    chosen = [name for name in CHECKS if (not only or name in only) and (subject.is_direct or name not in _DIRECT_ONLY)]
    found: list[Finding] = []
    with torch.random.fork_rng(devices=[]):
        broken = list(_build(subject))
        if broken:
            found += broken
            for name in dict.fromkeys((*(f.check for f in broken), *chosen)):
                mine = [f for f in broken if f.check == name]
                on_check(name, mine or None)
            return found
        for name in chosen:
            try:
                findings = list(_run(name, subject, found))
            except NotRunError as reason:
                on_check(name, None)
                on_note(name, f"not run: {reason}")
                continue
            found += findings
            on_check(name, findings)
            if name in subject.notes:
                on_note(name, subject.notes[name])
    return found


def record_layout(task: str | Path, *, agent: str | None = None, overrides: Sequence[str] = ()) -> Path:
    """Write down the columns of a task's observations and actions, beside its configuration; `layout` compares later.

    Returns:
        The file.

    Raises:
        ConfigError: if the task is not valid.
        TaskError: if there is no such task, or it cannot be imported.
    """
    return portability_checks.record_layout(open_task(task, agent, overrides))


def _build(subject: TaskUnderTest) -> Iterator[Finding]:
    """Nothing can be checked of a task that cannot be built."""
    try:
        subject.env()
    except ConfigError as error:
        for problem in error.problems:
            # a term's first value is looked at when the environment is built
            check = "shapes" if isinstance(error, ShapeError) else "names"
            where = f"{problem.where}: {problem.path}" if problem.path else problem.where
            yield Finding(
                check, "error", where, problem.message, problem.hint or "mend it; `rlcli validate --deep` agrees"
            )
    except (TaskError, DependencyError, DeviceError, MachineError):
        raise
    except Exception as error:
        yield _stopped("names", subject, error, [])


def _run(name: str, subject: TaskUnderTest, before: list[Finding]) -> Iterator[Finding]:
    try:
        for finding in CHECKS[name](subject):
            yield replace(finding, check=name)
    except (NotRunError, MachineError):
        raise
    except Exception as error:
        yield _stopped(name, subject, error, before)


def _stopped(name: str, subject: TaskUnderTest, error: Exception, before: list[Finding]) -> Finding:
    message = f"the check was stopped by {error_text(error)}"
    earlier = next((f.check for f in before if f.message == message), None)
    hint = "mend what raises it, then check again" if earlier is None else f"see {earlier}"
    return Finding(name, "error", subject.place(error), message, hint)

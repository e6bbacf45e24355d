"""Run the checks of `rlcli check`, which test whether a task keeps its contract.

The contract is the rules for shapes, seeds, resets and so on, on which trainers and checkpoints rely. An error in a
check becomes a finding, and the other checks still run.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from rlcli.errors import ConfigError, DependencyError, DeviceError, MachineError, ShapeError, TaskError, require_known
from rlcli.progress import track, tracked
from rlcli.runs.atomic_io import write_atomic
from rlcli.testing import episode_checks, file_checks, same_result_checks, step_checks
from rlcli.testing.findings import Finding, NotRunError, task_error_text
from rlcli.testing.task_under_test import NUM_ENVS, TaskUnderTest, open_task

Check = Callable[[TaskUnderTest], Iterable[Finding]]
OnCheck = Callable[[str, "list[Finding] | None"], None]
"""Function that receives the name of each check and its findings; None: the check did not run."""
OnNote = Callable[[str, str], None]
"""Function that receives the name of a check and a text that is not a finding, such as a measured speed."""

_steps, _episodes, _equivalence = step_checks, episode_checks, same_result_checks
_IN_ORDER: tuple[Check, ...] = (
    *(file_checks.names, file_checks.yaml_round_trip, _steps.finite, _steps.shapes, _steps.dtypes),
    *(_steps.random_actions, _steps.extreme_actions, _episodes.same_seed, _episodes.start_states),
    *(_steps.constant_columns, _steps.aliasing, _episodes.partial_reset, _episodes.final_observations),
    *(_episodes.truncation, _episodes.termination, _episodes.repeated_observation),
    *(_episodes.observation_after_reset, _episodes.back_fill),
    *(_equivalence.checkpoint, _equivalence.layout, _equivalence.policy, _equivalence.threads),
    *(_equivalence.num_envs, _equivalence.speed, _equivalence.engines, _equivalence.captured),
)
CHECKS = {check.__name__.replace("_", "-"): check for check in _IN_ORDER}
"""Name -> check, in the order in which the checks run; `docs/tutorials/first-plugin.md` lists all checks.

The first line of a check's docstring is its requirement."""

_DIRECT_ONLY = ("observation-after-reset",)


def check_task(
    task: str | Path,
    *,
    agent: str | None = None,
    overrides: Sequence[str] = (),
    config: Path | None = None,
    num_envs: int = NUM_ENVS,
    seed: int = 0,
    only: Sequence[str] = (),
    on_check: OnCheck = lambda name, findings: None,
    on_note: OnNote = lambda name, text: None,
) -> list[Finding]:
    """Check whether a task keeps the contract: the rules for shapes, seeds, resets and so on that every task must keep.

    Args:
        task: a name from `list-tasks`, or a folder with a `task.yaml`.
        agent: name of the agent; its action bound and its changes of the task are used; None: the default agent.
        overrides: `key.path=value`, as on the command line.
        config: a further configuration file, like that of `--config`; None: no file.
        num_envs: number of environments, which replaces the task's number; at least 8.
        seed: seed of the environments and of the actions.
        only: names of checks to run; all if empty.
        on_check: called after each check with the check's name and findings; with None if the check was not run.
        on_note: called after a check with its name and a note: why the check was not run, or what it measured.

    Returns:
        The violations of the contract; empty if there are none.

    Raises:
        UsageError: for the name of a check that does not exist, or fewer than 8 environments.
        ConfigError: if the task's files are not valid; `rlcli validate` prints the same errors.
        TaskError: if there is no such task, or the task cannot be imported.
    """
    for name in only:
        require_known(name, list(CHECKS), "check", "checks")
    subject = open_task(task, agent, overrides, config, num_envs, seed)
    selected = [n for n in CHECKS if (not only or n in only) and (subject.is_direct or n not in _DIRECT_ONLY)]
    found: list[Finding] = []
    with torch.random.fork_rng(devices=[]):
        broken = list(_build(subject))
        if broken:
            for name in dict.fromkeys((*(f.check for f in broken), *selected)):
                on_check(name, [f for f in broken if f.check == name] or None)
            return broken
        for name in tracked(selected, "checks", len(selected)):
            try:
                with track(name):
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


def record_layout(
    task: str | Path, *, agent: str | None = None, overrides: Sequence[str] = (), config: Path | None = None
) -> Path:
    """Record the columns of a task's observations and actions beside its configuration, for the check `layout`.

    The arguments are those of `check_task`.

    Returns:
        The written file, `task.layout.json` for `task.yaml`.

    Raises:
        ConfigError: if the task is not valid.
        TaskError: if there is no such task, or the task cannot be imported.
    """
    subject = open_task(task, agent, overrides, config, NUM_ENVS, 0)
    record, file = subject.env().layout.record(), same_result_checks.layout_file(subject)
    columns = {part: record[part] for part in ("observations", "actions")}
    return write_atomic(file, json.dumps(columns, indent=1) + "\n")  # a link at this path is replaced, not followed


def _build(subject: TaskUnderTest) -> Iterator[Finding]:
    """Build the environment; yield the findings if that fails, since no check can run then."""
    try:
        subject.env()
    except ConfigError as error:
        for problem in error.problems:
            # the environment checks the shape of a term's first value while it is built
            check = "shapes" if isinstance(error, ShapeError) else "names"
            where = f"{problem.where}: {problem.path}" if problem.path else problem.where
            hint = problem.hint or "correct this setting; `rlcli validate --deep` reports the same problem"
            yield Finding(check, "error", where, problem.message, hint)
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
    message = f"the check was stopped by {task_error_text(error)}"
    earlier = next((f.check for f in before if f.message == message), None)
    advice = getattr(error, "hint", None) or "correct the code that raises this error, then check again"
    hint = advice if earlier is None else f"first correct what the check {earlier} reports: the error is the same"
    return Finding(name, "error", subject.location(error), message, hint)

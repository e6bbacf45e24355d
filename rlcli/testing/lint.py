"""Linter of tasks (`rlcli lint`), which finds properties that make learning hard, even if a task passes `rlcli check`.

```python
from rlcli.testing import lint_task

for finding in lint_task("acrobot"):
    print(finding)
```
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from rlcli.errors import ConfigError, MachineError, UsageError, require_known
from rlcli.progress import tracked
from rlcli.testing.findings import task_error_text
from rlcli.testing.fixed_policy_rollouts import RolloutEvidence
from rlcli.testing.lint_rules import RULES
from rlcli.testing.remarks import Remark
from rlcli.testing.task_under_test import open_task


def lint_task(
    task: str | Path,
    *,
    agent: str | None = None,
    overrides: Sequence[str] = (),
    config: Path | None = None,
    num_envs: int = 16,
    seed: int = 0,
    seconds: float | None = None,
    only: Sequence[str] = (),
    ignore: Sequence[str] = (),
    on_rule: Callable[[str, list[Remark]], None] = lambda name, remarks: None,
) -> list[Remark]:
    """Run a task with fixed policies, such as random actions, and apply the rules of the linter to the rollouts.

    Args:
        task: a name from `list-tasks`, or a folder with a `task.yaml`.
        agent: name of the agent; its action bound, its discount factor and its changes of the task are used; None: the
            default agent.
        overrides: `key.path=value`, as on the command line.
        config: a further configuration file, like that of `--config`; None: no file.
        num_envs: number of environments of each rollout, which replaces the task's number; at least 8.
        seed: seed of the environments and of the fixed policies.
        seconds: simulated time of each rollout [s]; None: one episode, but at most 1000 steps.
        only: names of rules; all if empty.
        ignore: names of rules that are left out.
        on_rule: called after each rule with its name and remarks.

    Returns:
        A remark for each obstacle to learning; empty if there are none.

    Raises:
        UsageError: for the name of a rule that does not exist, `seconds` not above 0, or fewer than 8 environments.
        ConfigError: if the task is not valid; `rlcli validate --deep` prints the same errors.
        TaskError: if there is no such task, or the task cannot be imported.
    """
    for name in (*only, *ignore):
        require_known(name, list(RULES), "rule", "rules")
    if seconds is not None and not (math.isfinite(seconds) and seconds > 0.0):
        raise UsageError(f"--seconds {seconds:g} is not a duration", hint="give a simulated time above 0 [s]")
    evidence = RolloutEvidence(open_task(task, agent, overrides, config, num_envs, seed), seconds)
    found: list[Remark] = []
    with torch.random.fork_rng(devices=[]):
        for name in _with_progress([name for name in RULES if name in (only or RULES) and name not in ignore]):
            remarks = list(_apply_rule(name, evidence))
            if evidence.stopped:  # the rollouts are incomplete, so no other rule applies
                remarks = list(_apply_rule("stops", evidence))
            found += remarks
            on_rule(name, remarks)
            if evidence.stopped:
                break
    return found


def _with_progress(names: Sequence[str]) -> Iterator[str]:
    """Yield the names of the rules, and report progress from the second rule on.

    The first rule records the rollouts, which take most of the time and report their own progress. As a part of one
    rule out of many, they would give a far too long estimate of the time left.
    """
    yield from names[:1]
    yield from tracked(names[1:], "rules", len(names) - 1)


def _apply_rule(name: str, evidence: RolloutEvidence) -> Iterator[Remark]:
    try:
        for remark in RULES[name](evidence):
            yield replace(remark, rule=name)
    except (ConfigError, MachineError):
        raise
    except Exception as error:
        message = f"the rule was stopped by {task_error_text(error)}"
        hint = getattr(error, "hint", None) or "correct the code that raises this error, then lint again"
        yield Remark(name, "error", evidence.subject.location(error), message, hint)

"""Command `rlcli check`: tests that a task keeps rlcli's rules for shapes, seeds, resets, rewards and devices.

The checks themselves are in `rlcli.testing`; this module prints their findings.
"""

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.ui.console import console
from rlcli.cli.ui.findings import report_findings
from rlcli.cli.ui.options import Agent, ConfigFile, FewEnvs, Overrides, Seed, TaskName

if TYPE_CHECKING:
    from rlcli.testing import Finding


def command(
    task: TaskName,
    overrides: Overrides = None,
    only: Annotated[list[str] | None, typer.Option(metavar="CHECK")] = None,
    record: Annotated[bool, typer.Option("--record-layout")] = False,
    agent: Agent = None,
    config: ConfigFile = None,
    num_envs: FewEnvs = 8,
    seed: Seed = 0,
) -> None:
    """Check that a task keeps rlcli's rules (its contract) for shapes, seeds, resets, rewards and devices.

    Options:
        only: Run only the check with this name; repeatable.
        record: Write the names of all observation and action columns to task.layout.json in the task's folder. From
            then on, the check `layout` compares the task with this file.

    Examples:
        rlcli check cartpole
            Run all checks on an installed task.
        rlcli check ./my_task --only partial-reset
            Run one check on a task in a folder.
    """
    from rlcli.runs.trusted_tasks import named_task

    named_task(task)  # a missing task is reported before anything heavy is imported
    import torch

    from rlcli.testing import check_task, record_layout

    torch.set_num_threads(1)
    if record:
        file = record_layout(task, agent=agent, overrides=overrides or (), config=config)
        console.info(f"recorded the observation and action columns in {file}")
    checks: list[tuple[str, list[Finding] | None]] = []
    notes: dict[str, str] = {}
    findings = check_task(
        task,
        agent=agent,
        overrides=overrides or (),
        config=config,
        num_envs=num_envs,
        seed=seed,
        only=only or (),
        on_check=lambda name, found: checks.append((name, found)),
        on_note=notes.__setitem__,
    )
    report_findings("check", task, "check", checks, [asdict(finding) for finding in findings], notes=notes)

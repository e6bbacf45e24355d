"""`rlcli lint TASK`: what a task does under agents that know nothing, as a table of rules and a list of remarks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.ui.console import console
from rlcli.cli.ui.findings import result_of, show_findings
from rlcli.cli.ui.options import Agent, Overrides, TaskName

if TYPE_CHECKING:
    from rlcli.testing import Remark


def command(
    task: TaskName,
    overrides: Overrides = None,
    seconds: Annotated[
        float | None, typer.Option(help="Simulated seconds that each agent acts for; else an episode or 1000 steps.")
    ] = None,
    only: Annotated[list[str] | None, typer.Option(help="Run only this rule; repeatable.")] = None,
    ignore: Annotated[list[str] | None, typer.Option(help="Leave this rule out; repeatable.")] = None,
    agent: Agent = None,
) -> None:
    """Look for what will get in the way of learning. Rewards, resets, observations, actions, time step, discount."""
    from rlcli.runs.trusted_tasks import named_task

    named_task(task)  # a missing task is reported before anything heavy is imported
    import torch

    from rlcli.testing import lint_task

    torch.set_num_threads(1)
    rules: list[tuple[str, list[Remark]]] = []
    remarks = lint_task(
        task,
        agent=agent,
        overrides=overrides or (),
        seconds=seconds,
        only=only or (),
        ignore=ignore or (),
        on_rule=lambda name, found: rules.append((name, found)),
    )
    show_findings(task, "RULE", rules, remarks)
    console.document(
        "lint",
        task=task,
        passed=not remarks,
        rules=[{"name": name, "result": result_of(found)} for name, found in rules],
        findings=[remark.record() for remark in remarks],
    )
    if remarks:
        raise typer.Exit(9)

"""`rlcli check TASK`: the contract kit, as a table of checks and a list of findings."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.ui.console import console
from rlcli.cli.ui.findings import count_errors, result_of, show_findings
from rlcli.cli.ui.options import Agent, Overrides, TaskName

if TYPE_CHECKING:
    from rlcli.testing import Finding


def command(
    task: TaskName,
    overrides: Overrides = None,
    only: Annotated[list[str] | None, typer.Option(help="Run only this check; repeatable.")] = None,
    record: Annotated[
        bool, typer.Option("--record-layout", help="Write down the columns of observations and actions, for `layout`.")
    ] = False,
    agent: Agent = None,
) -> None:
    """Check that a task keeps its contract."""
    from rlcli.runs.trusted_tasks import named_task

    named_task(task)  # a missing task is reported before anything heavy is imported
    import torch

    from rlcli.testing import check_task, record_layout

    torch.set_num_threads(1)
    if record:
        console.info(f"recorded {record_layout(task, agent=agent, overrides=overrides or ())}")
    checks: list[tuple[str, list[Finding] | None]] = []
    notes: dict[str, str] = {}
    findings = check_task(
        task,
        agent=agent,
        overrides=overrides or (),
        only=only or (),
        on_check=lambda name, found: checks.append((name, found)),
        on_note=notes.__setitem__,
    )
    show_findings(task, "CHECK", checks, findings, notes)
    passed = count_errors(findings) == 0
    results = [{"name": name, "result": result_of(found), "note": notes.get(name)} for name, found in checks]
    entries = [asdict(finding) for finding in findings]
    console.document("check", task=task, passed=passed, checks=results, findings=entries)
    if not passed:
        raise typer.Exit(9)

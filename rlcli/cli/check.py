"""`rlcli check TASK`: the contract kit, as a table of checks and a list of findings."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.completion import tasks
from rlcli.cli.console import console
from rlcli.cli.options import Agent, Debug, Json, Overrides, Quiet, Verbose

if TYPE_CHECKING:
    from rlcli.testing import Finding


def command(
    task: Annotated[
        str,
        typer.Argument(autocompletion=tasks, help="A task's name, distribution:name, or a folder with a task.yaml."),
    ],
    overrides: Overrides = None,
    only: Annotated[list[str] | None, typer.Option("--only", help="Run only this check; repeatable.")] = None,
    record: Annotated[
        bool, typer.Option("--record-layout", help="Write down the columns of observations and actions, for `layout`.")
    ] = False,
    agent: Agent = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Check that a task keeps its contract."""
    from rlcli.rl.trust import named_task

    named_task(task)  # what is not there is said before anything heavy is imported
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
    errors = sum(f.severity == "error" for f in findings)
    warnings = len(findings) - errors
    console.table(["CHECK", "RESULT"], [[name, _result(found)] for name, found in checks])
    for name, text in notes.items():
        console.data(f"note: {name}: {text}")
    for finding in findings:
        console.data(str(finding))
    console.data(f"{task}: {_count(errors, 'error')}, {_count(warnings, 'warning')}")
    console.document(
        "check",
        task=task,
        passed=errors == 0,
        checks=[{"name": name, "result": _result(found), "note": notes.get(name)} for name, found in checks],
        findings=[asdict(finding) for finding in findings],
    )
    if errors:
        raise typer.Exit(9)


def _result(found: list[Finding] | None) -> str:
    if found is None:
        return "not run"
    if any(f.severity == "error" for f in found):
        return "error"
    return "warning" if found else "ok"


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"

"""`rlcli lint TASK`: what a task does under agents that know nothing, as a table of rules and a list of remarks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.completion import tasks
from rlcli.cli.console import console
from rlcli.cli.options import Agent, Debug, Json, Overrides, Quiet, Verbose

if TYPE_CHECKING:
    from rlcli.testing import Remark


def command(
    task: Annotated[
        str,
        typer.Argument(autocompletion=tasks, help="A task's name, distribution:name, or a folder with a task.yaml."),
    ],
    overrides: Overrides = None,
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", help="Simulated seconds that each agent acts for; else an episode or 1000 steps."),
    ] = None,
    only: Annotated[list[str] | None, typer.Option("--only", help="Run only this rule; repeatable.")] = None,
    ignore: Annotated[list[str] | None, typer.Option("--ignore", help="Leave this rule out; repeatable.")] = None,
    agent: Agent = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Look for what will get in the way of learning. Rewards, resets, observations, actions, time step, discount."""
    from rlcli.rl.trust import named_task

    named_task(task)  # what is not there is said before anything heavy is imported
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
    console.table(["RULE", "RESULT"], [[name, _result(found)] for name, found in rules])
    for remark in remarks:
        console.data(str(remark))
    errors = sum(r.severity == "error" for r in remarks)
    warnings = len(remarks) - errors
    console.data(f"{task}: {_count(errors, 'error')}, {_count(warnings, 'warning')}")
    console.document(
        "lint",
        task=task,
        passed=not remarks,
        rules=[{"name": name, "result": _result(found)} for name, found in rules],
        findings=[remark.record() for remark in remarks],
    )
    if remarks:
        raise typer.Exit(9)


def _result(found: list[Remark]) -> str:
    if any(r.severity == "error" for r in found):
        return "error"
    return "warning" if found else "ok"


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"

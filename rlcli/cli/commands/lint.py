"""Command `rlcli lint`: search for properties of a task that make learning hard, such as a reward that never changes.

The linter runs simple fixed policies (zero, random, bang-bang, sine). Each rule searches the rollouts of these policies
for one property. `rlcli.testing.lint_rules.RULES` contains all rules.
"""

from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.ui.findings import report_findings
from rlcli.cli.ui.options import Agent, ConfigFile, FewEnvs, Overrides, Seed, TaskName

if TYPE_CHECKING:
    from rlcli.testing import Remark


def command(
    task: TaskName,
    overrides: Overrides = None,
    seconds: Annotated[float | None, typer.Option()] = None,
    only: Annotated[list[str] | None, typer.Option(metavar="RULE")] = None,
    ignore: Annotated[list[str] | None, typer.Option(metavar="RULE")] = None,
    agent: Agent = None,
    config: ConfigFile = None,
    num_envs: FewEnvs = 16,
    seed: Seed = 0,
) -> None:
    """Find what makes a task hard to learn: run simple fixed policies, and check their episodes.

    The policies are zero, random, bang-bang and sine actions. The rules check rewards, resets, observations, actions,
    the time step and the discount. The report has one line for each rule, with its name.

    Options:
        seconds: Simulated time for which each fixed policy acts [s]. [default: an episode, at most 1000 steps]
        only: Run only the rule with this name; repeatable.
        ignore: Leave out the rule with this name; repeatable.

    Examples:
        rlcli lint cartpole
            Run all rules on an installed task.
        rlcli lint ./my_task --only dominant-reward --seconds 5
            Run one rule on five simulated seconds of each policy.
    """
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
        config=config,
        num_envs=num_envs,
        seed=seed,
        seconds=seconds,
        only=only or (),
        ignore=ignore or (),
        on_rule=lambda name, found: rules.append((name, found)),
    )
    report_findings("lint", task, "rule", rules, [remark.record() for remark in remarks], fail_on_warnings=True)

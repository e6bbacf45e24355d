"""`rlcli eval`: how good a policy is, with intervals, and whether it is good enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.ui import options
from rlcli.cli.ui.console import SCHEMA_VERSION, console
from rlcli.errors import UsageError

if TYPE_CHECKING:
    from rlcli.evaluation.limits import Limit
    from rlcli.evaluation.session import PolicyRequest


def command(
    task: options.TaskOfPolicy = None,
    overrides: options.Overrides = None,
    compare: Annotated[
        bool,
        typer.Option(
            "--compare",
            help="RUN1 RUN2 [...] in the same episodes: eval --compare A B; beside a run also shipped, lqr, zero or"
            " random. --fail-under and --fail-over are of the first.",
        ),
    ] = False,
    checkpoint: options.CheckpointRef = None,
    policy: options.Policy = "trained",
    episodes: Annotated[int, typer.Option(min=1, help="Episodes to run, each environment's first ones.")] = 200,
    fail_under: Annotated[
        list[str] | None,
        typer.Option(
            help="success=0.99, return=4, length=250, reward_terms.NAME=X, terminations.NAME=X, or a value of the task"
            " (speed=5): exit 9 below; success.low=0.99 and the like: of the interval's lower end; repeatable."
        ),
    ] = None,
    fail_over: Annotated[
        list[str] | None,
        typer.Option(
            help="The same names, error_vel_xy=0.25: exit 9 above; KEY.high=X: of the interval's upper end; repeatable."
        ),
    ] = None,
    stochastic: options.Stochastic = False,
    record: options.Record = None,
    record_mode: options.RecordMode = "all",
    num_envs: options.NumEnvs = None,
    seed: options.Seed = 42,
    config: options.ConfigFile = None,
    runs_dir: options.RunsDir = None,
    headless: options.Headless = True,
) -> None:
    """Evaluate a policy."""
    from rlcli.cli.ui.evaluation_tables import show_summary
    from rlcli.evaluation import session as sessions
    from rlcli.evaluation.limits import failures, read_limits, require_success

    limits = read_limits(fail_under, fail_over)
    request = sessions.PolicyRequest(
        task, overrides or [], checkpoint, policy, stochastic, num_envs, options.draw_seed(seed), config, runs_dir
    )
    if compare:
        if checkpoint is not None or policy != "trained" or record is not None:
            raise UsageError("--compare takes its policies as words: eval --compare RUN1 RUN2")
        _compare(request, episodes, limits)
        return
    sessions.check_record(record, record_mode)
    session = sessions.open_session(request, lambda resolved: require_success(resolved, [each.key for each in limits]))
    summary, recorded = sessions.run_episodes(session, episodes, record, record_mode)
    failed = failures(summary, limits)
    show_summary(summary)
    document = sessions.evaluation_record(session, summary)
    sessions.save_evaluation(session, {"schema": SCHEMA_VERSION, "command": "eval", **document})
    console.document("eval", **document, passed=not failed, failures=failed, recorded=recorded)
    options.exit_on_failures(failed)


def _compare(request: PolicyRequest, episodes: int, limits: Sequence[Limit]) -> None:
    """Compare the policies that stand where a task and its overrides would."""
    from rlcli.cli.ui.evaluation_tables import show_comparison
    from rlcli.evaluation.comparison import compare, find_policies
    from rlcli.evaluation.limits import failures, require_success

    words = [*([] if request.task is None else [request.task]), *request.overrides]
    names = [word for word in words if "=" not in word]
    overrides = [word for word in words if "=" in word]
    policies = find_policies(names, replace(request, task=None, overrides=overrides))
    resolved = policies[0].resolved
    require_success(resolved, [limit.key for limit in limits])
    comparison = compare(names, policies, episodes)
    failed = failures(comparison.summaries[0], limits)
    task = resolved.task
    console.data(
        f"{resolved.source.name}: {episodes} episodes each, seed {request.seed}, the same ones;"
        f" {task.max_episode_length} steps of {task.step_dt:.6g} s at most{''.join(f', {word}' for word in overrides)}"
    )
    show_comparison(comparison)
    console.document("eval", overrides=overrides, **comparison.record(), passed=not failed, failures=failed)
    options.exit_on_failures(failed)

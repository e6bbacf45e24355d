"""Command `rlcli eval`: evaluation of a policy over many episodes, or comparison of several policies.

The command prints means and rates with confidence intervals. It fails with exit code 9 if a limit such as
`--fail-under` is missed.
"""

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
    compare: Annotated[bool, typer.Option("--compare")] = False,
    checkpoint: options.CheckpointRef = None,
    policy: options.Policy = "trained",
    episodes: Annotated[int, typer.Option(min=1)] = 200,
    fail_under: Annotated[list[str] | None, typer.Option(metavar="KEY=X")] = None,
    fail_over: Annotated[list[str] | None, typer.Option(metavar="KEY=X")] = None,
    stochastic: options.Stochastic = False,
    record: options.Record = None,
    record_mode: options.RecordMode = "all",
    num_envs: options.NumEnvs = None,
    seed: options.Seed = 42,
    config: options.ConfigFile = None,
    runs_dir: options.RunsDir = None,
    headless: options.Headless = True,
) -> None:
    """Evaluate a policy over many episodes, with confidence intervals.

    Options:
        compare: Compare several runs in the same episodes: eval --compare RUN1 RUN2. Further policies: shipped,
            lqr, zero, random. --fail-under and --fail-over apply to the first run.
        episodes: Number of episodes. By default each has its own environment (at most 8192 at a time); with --num-envs
            N each environment runs its share of them.
        fail_under: Exit with code 9 if a mean is below X. Keys: success, return, length, reward_terms.NAME,
            terminations.NAME, a metric of the task (speed); KEY.low is the lower end of the interval; repeatable.
        fail_over: Exit with code 9 if a mean is above X. The same keys; KEY.high is the upper end; repeatable.

    Examples:
        rlcli eval cartpole --fail-under success.low=0.95
            Evaluate the newest run; fail if its success rate may be below 95 %.
        rlcli eval --compare latest shipped --episodes 500
            Compare the newest run with the policy that its task ships.
    """
    from rlcli.cli.ui.evaluation_tables import show_summary
    from rlcli.evaluation import session as sessions
    from rlcli.evaluation.limits import failures, read_limits, require_success

    limits, words = read_limits(fail_under, fail_over), overrides or []
    request = sessions.PolicyRequest(
        task, words, checkpoint, policy, stochastic, num_envs, seed, config, runs_dir, episodes
    )
    if compare:
        given = {"--checkpoint": checkpoint, "--policy": policy if policy != "trained" else None, "--record": record}
        for option in [option for option, value in given.items() if value is not None]:
            raise UsageError(f"--compare cannot be combined with {option}", hint="use rlcli eval --compare RUN1 RUN2")
        _compare(request, episodes, limits)
        return
    sessions.check_record(record, record_mode)
    session = sessions.open_session(request, lambda resolved: require_success(resolved, [each.key for each in limits]))
    summary, recorder = sessions.run_episodes(session, episodes, records=record is not None)
    failed = failures(summary, limits)
    show_summary(summary)
    recorded, unsaved = sessions.save_episodes(recorder, record, record_mode)
    document = sessions.evaluation_record(session, summary)
    sessions.save_evaluation(session, {"schema": SCHEMA_VERSION, "command": "eval", **document})
    console.document("eval", **document, passed=not failed, failures=failed, recorded=recorded)
    if unsaved is not None:
        raise unsaved
    options.exit_on_failures(failed)


def _compare(request: PolicyRequest, episodes: int, limits: Sequence[Limit]) -> None:
    """Run `rlcli eval --compare`: its arguments are the names of policies and overrides that apply to all of them."""
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
        f"{resolved.source.name}: the same {episodes} episodes for each, seed {request.seed};"
        f" at most {task.max_episode_length} steps of {task.step_dt:.6g} s{''.join(f', {word}' for word in overrides)}"
    )
    show_comparison(comparison)
    console.document("eval", overrides=overrides, **comparison.record(), passed=not failed, failures=failed)
    options.exit_on_failures(failed)

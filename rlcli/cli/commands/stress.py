"""Command `rlcli stress`: evaluation of a policy with changed masses, frictions, delays and other parameters.

The command prints a table and a heat map of the success rate or the return. It fails with exit code 9 if a minimum
(`--fail-under`) is missed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.ui import options
from rlcli.cli.ui.completion import runs_and_tasks
from rlcli.cli.ui.console import console
from rlcli.errors import UsageError

if TYPE_CHECKING:
    from rlcli.evaluation.session import PolicyInTask, PolicyRequest
    from rlcli.evaluation.stress import StressResult
    from rlcli.evaluation.stress_parameters import Sweep
    from rlcli.reporting.heat_map import HeatMap


def command(
    subject: Annotated[str | None, typer.Argument(autocompletion=runs_and_tasks, metavar="RUN|TASK")] = None,
    overrides: options.Overrides = None,
    sweep: Annotated[list[str] | None, typer.Option(metavar="NAME=RANGE")] = None,
    points: Annotated[int, typer.Option(min=2, max=1000)] = 5,
    episodes: Annotated[int, typer.Option(min=1)] = 100,
    worst: Annotated[int, typer.Option(min=0, max=10_000)] = 0,
    against: Annotated[str | None, typer.Option(metavar="POLICY")] = None,
    policy: options.Policy = "trained",
    checkpoint: options.CheckpointRef = None,
    stochastic: options.Stochastic = False,
    fail_under: Annotated[list[str] | None, typer.Option(metavar="KEY=X")] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", metavar="FILE")] = None,
    num_envs: options.NumEnvs = None,
    seed: options.Seed = 42,
    config: options.ConfigFile = None,
    runs_dir: options.RunsDir = None,
) -> None:
    """Evaluate a policy in variants of its task: other masses, frictions, delays, noise, pushes.

    Options:
        subject: A run, RUN@best, RUN@step:N or latest; or a task, for its newest run.
        sweep: NAME[.ELEMENT]=LOW:HIGH[:POINTS] or =A,B,C; repeatable: all combinations are evaluated. Factors on
            body_mass, joint_damping, joint_friction, joint_armature, joint_stiffness, geom_friction,
            actuator_gain, effort_limit, gravity or a field of the model (abs:LOW:HIGH sets the value);
            action_delay and observation_delay [control steps], action_noise and observation_noise [std],
            push [m/s or rad/s].
        points: Number of values in a range.
        episodes: Number of episodes in each variant.
        worst: Number of further random variants within the ranges; half of them are near the worst variant of the grid.
        against: Other policy to compare with: lqr, zero or random.
        fail_under: Exit with code 9 if the mean is below X in any variant, such as success=0.9; repeatable.
        output: Write the heat map to FILE.png or FILE.svg.

    Examples:
        rlcli stress latest --sweep body_mass=0.5:2
            Evaluate the newest run with half to twice the mass, in five steps.
        rlcli stress cartpole --sweep action_delay=0:3 --against lqr -o map.png
            Compare the newest run with an LQR under delays; write the heat map.
    """
    from rlcli.evaluation.limits import read_limits, require_success
    from rlcli.evaluation.session import PolicyRequest, baseline, find_policy, split_overrides
    from rlcli.reporting.heat_map import FORMATS, draw
    from rlcli.reporting.matplotlib_plots import check_drawing

    task, words = split_overrides(subject, overrides or [])
    if task is None and checkpoint is None:
        raise UsageError("no run, task or checkpoint given", hint="rlcli stress latest --sweep body_mass=0.5:2")
    sweeps, limits = _read_sweeps(sweep, points), read_limits(fail_under)
    if output is not None:
        options.check_output(output, "picture", FORMATS)
        check_drawing()
    request = PolicyRequest(task, words, checkpoint, policy, stochastic, num_envs, seed, config, runs_dir)
    keys = [limit.key for limit in limits]
    tested = find_policy(_resolve_run(request), lambda resolved: require_success(resolved, keys))
    reference = None if against is None else baseline(tested, against)
    from rlcli.evaluation.stress import stress

    result = stress(tested, sweeps, episodes, worst=worst, reference=reference)
    failed = result.failures(limits)
    maps = _show(result, policy, against)
    if output is not None:
        draw(output, maps)
        console.info(f"wrote {output}")
    document = {**_record(tested), **result.record(against), "picture": str(output) if output else None}
    console.document("stress", **document, passed=not failed, failures=failed)
    options.exit_on_failures(failed)


def _record(tested: PolicyInTask) -> dict[str, Any]:
    return {
        "task": tested.resolved.source.name,
        "checkpoint": str(tested.checkpoint) if tested.checkpoint else None,
        "policy": tested.kind,
        "stochastic": tested.stochastic,
        "seed": tested.seed,
    }


def _read_sweeps(texts: list[str] | None, points: int) -> list[Sweep]:
    from rlcli.evaluation.stress_parameters import read_sweeps

    if not texts:
        raise UsageError("no --sweep given", hint="for example: --sweep body_mass=0.5:2 or --sweep action_delay=0:3")
    return read_sweeps(texts, points)


def _resolve_run(request: PolicyRequest) -> PolicyRequest:
    """Return the request with its checkpoint filled in if the first argument (`RUN|TASK`) is a run.

    Raises:
        UsageError: if --checkpoint is given too.
    """
    from rlcli.evaluation.session import is_run_name

    task = request.task
    if task is None or not is_run_name(task, request.runs_dir):
        return request
    if request.checkpoint is not None:
        raise UsageError(f"{task} is a run, and --checkpoint names one too", hint="leave out one of them")
    return replace(request, task=None, checkpoint=task)


def _show(result: StressResult, policy: str, against: str | None) -> list[HeatMap]:
    """Print the table, the heat maps and the worst variant; return the heat maps."""
    from rlcli.cli.ui.evaluation_tables import interval, show_stress
    from rlcli.evaluation.limits import mean_or_rate
    from rlcli.evaluation.stress_parameters import describe_point
    from rlcli.reporting.heat_map import heat_maps

    show_stress(result, against)
    metric = result.metric
    values = [(policy, {point: mean_or_rate(summary[metric]) for point, summary in result.grid.items()})]
    if against is not None:
        values.append((against, {point: mean_or_rate(result.reference[point][metric]) for point in result.grid}))
    maps = heat_maps(result.sweeps, values, metric)
    for heat_map in maps:
        console.data("")
        console.heat_map(heat_map.title, f"{heat_map.rows.name} / {heat_map.columns.name}".strip(" /"), heat_map)
    worst = result.worst
    entry = {**result.grid, **result.searched}[worst][metric]
    where = "variant found by the search" if worst in result.searched else "variant of the grid"
    text = f"{metric} {mean_or_rate(entry):.4f} ({interval(entry)})"
    console.data("")
    console.data(f"worst {where}: {describe_point(result.sweeps, worst)}: {text}")
    return maps

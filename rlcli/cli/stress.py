"""`rlcli stress`: how far a policy carries when masses, frictions, delays, ... are not what they were."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.completion import runs_and_tasks
from rlcli.cli.console import console
from rlcli.cli.options import (
    CheckpointRef,
    ConfigFile,
    Debug,
    Json,
    NumEnvs,
    Overrides,
    Quiet,
    RunsDir,
    Seed,
    Verbose,
    draw_seed,
)

if TYPE_CHECKING:
    from rlcli.cli.session import Subject
    from rlcli.rl.heat_map import HeatMap
    from rlcli.rl.rollout import Evaluation
    from rlcli.rl.sweeps import Point, Sweep

_MOST = 10_000
"""Variants."""


def command(
    subject: Annotated[
        str | None,
        typer.Argument(
            autocompletion=runs_and_tasks,
            metavar="RUN|TASK",
            help="A run, RUN@best, RUN@step:N or latest; or a task: its newest run.",
        ),
    ] = None,
    overrides: Overrides = None,
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            "--sweep",
            help="NAME[.ELEMENT]=LOW:HIGH[:POINTS] or =A,B,C; repeatable, every combination is tried. Factors on"
            " body_mass, joint_damping, joint_friction, joint_armature, joint_stiffness, geom_friction, actuator_gain,"
            " effort_limit, gravity or a field of the model (abs:LOW:HIGH sets it); action_delay and observation_delay"
            " [control steps], action_noise and observation_noise [std], push [m/s or rad/s].",
        ),
    ] = None,
    points: Annotated[int, typer.Option("--points", min=2, max=1000, help="Values of a range.")] = 5,
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="Episodes in each variant.")] = 100,
    worst: Annotated[
        int, typer.Option("--worst", min=0, max=10_000, help="Look for a worse case at so many further points.")
    ] = 0,
    against: Annotated[
        str | None, typer.Option("--against", help="A known answer beside it: lqr, zero or random.")
    ] = None,
    policy: Annotated[str, typer.Option("--policy", help="trained, zero, random or lqr.")] = "trained",
    checkpoint: CheckpointRef = None,
    stochastic: Annotated[bool, typer.Option("--stochastic", help="Sample actions as in training.")] = False,
    fail_under: Annotated[
        list[str] | None,
        typer.Option(
            "--fail-under", help="success=0.9 and the like, as in eval: exit 9 if it is below in any variant."
        ),
    ] = None,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Draw the map to FILE.png or FILE.svg.")] = None,
    num_envs: NumEnvs = None,
    seed: Seed = 42,
    config: ConfigFile = None,
    runs_dir: RunsDir = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Evaluate a policy in variants of its task."""
    from rlcli.cli.eval import read_limits, require_success, value_of, verdict
    from rlcli.cli.session import actor, baseline, find_subject, names_run
    from rlcli.errors import UsageError
    from rlcli.rl.heat_map import check_picture, draw, heat_map
    from rlcli.rl.sweeps import grid, read_sweeps

    words = overrides or []
    if subject is not None and "=" in subject:
        words, subject = [subject, *words], None
    if subject is None and checkpoint is None:
        raise UsageError("stress what?", hint="a RUN, a TASK, or latest")
    if not sweep:
        raise UsageError("sweep what?", hint="--sweep body_mass=0.5:2, --sweep action_delay=0:3")
    sweeps, limits = read_sweeps(sweep, points), read_limits(fail_under or [])
    variants = grid(sweeps)
    if len(variants) > _MOST:
        raise UsageError(f"{len(variants):,} variants; {_MOST:,} are run", hint="fewer sweeps or --points")
    if output is not None:
        check_picture(output)
    if subject is not None and names_run(subject, runs_dir):
        if checkpoint is not None:
            raise UsageError(f"{subject} is a run, and --checkpoint names another", hint="leave one of them out")
        subject, checkpoint = None, subject
    judged = find_subject(
        subject,
        words,
        checkpoint=checkpoint,
        policy=policy,
        stochastic=stochastic,
        num_envs=num_envs,
        seed=draw_seed(seed),
        config=config,
        runs_dir=runs_dir,
        check=lambda resolved: require_success(resolved, limits),
    )
    other = None if against is None else baseline(judged, against)
    from rlcli.rl.stress import one_each, run_points, score, search

    task = one_each(judged.resolved, episodes)

    def run(who: Subject, at: list[Any]) -> list[Evaluation]:
        return run_points(task, actor(who), sweeps, at, episodes, judged.seed)

    console.info(f"{len(variants) + 1} variants, {episodes} episodes in each, seed {judged.seed}")
    nominal, *found = [result.summary() for result in run(judged, [None, *variants])]
    rival = [] if other is None else [result.summary() for result in run(other, [None, *variants])]
    summaries: dict[Point, dict[str, Any]] = dict(zip(variants, found, strict=True))
    where = min(summaries, key=lambda at: score(summaries[at]))
    searched: dict[Point, dict[str, Any]] = {}
    if worst:
        more = [at for at in search(sweeps, where, worst, judged.seed) if at not in summaries]
        searched = {at: r.summary() for at, r in zip(more, run(judged, more), strict=True)} if more else {}
    everything = {**summaries, **searched}
    where = min(everything, key=lambda at: score(everything[at]))
    failures = []
    for key, limit in limits.items():  # what is worst in success need not be so in return
        known = {at: value_of(summary, key) for at, summary in everything.items()}
        at = min(known, key=lambda at: -math.inf if (value := known[at]) is None else value)
        failures += [f"at {_at(sweeps, at)}: {said}" for said in verdict(everything[at], {key: limit})]

    metric = "success" if "success" in nominal else "return"
    _table(sweeps, [None, *variants], [nominal, *found], rival, against, metric)
    maps = [heat_map(f"{metric}, {policy}", sweeps, {at: _middle(s[metric]) for at, s in summaries.items()}, None)]
    if rival:
        values = {at: _middle(s[metric]) for at, s in zip(variants, rival[1:], strict=True)}
        maps.append(heat_map(f"{metric}, {against}", sweeps, values, None))
    maps = _one_scale(maps, metric)
    for drawn in maps:
        console.data("")
        console.heat_map(drawn.title, f"{drawn.row_name} / {drawn.column_name}".strip(" /"), drawn)
    console.data("")
    how = "found by the search" if where in searched else "of the grid"
    console.data(f"worst {how}: {_at(sweeps, where)}: {metric} {_said(everything[where][metric])}")
    if output is not None:
        draw(output, maps)
        console.info(f"drawn to {output}")
    console.document(
        "stress",
        task=judged.resolved.source.name,
        checkpoint=str(judged.checkpoint) if judged.checkpoint else None,
        policy=policy,
        stochastic=stochastic,
        seed=judged.seed,
        num_envs=task.task.scene.num_envs,
        metric=metric,
        sweeps=[{"name": s.name, "unit": s.unit, "absolute": s.neutral != 1.0, "values": s.values} for s in sweeps],
        nominal=nominal,
        points=[{"at": _named(sweeps, at), **s} for at, s in summaries.items()],
        searched=[{"at": _named(sweeps, at), **s} for at, s in searched.items()],
        worst={"at": _named(sweeps, where), "found": "search" if where in searched else "grid", **everything[where]},
        against=None
        if not rival
        else {
            "policy": against,
            "nominal": rival[0],
            "points": [{"at": _named(sweeps, at), **s} for at, s in zip(variants, rival[1:], strict=True)],
        },
        picture=str(output) if output else None,
        passed=not failures,
        failures=failures,
    )
    if failures:
        for failure in failures:
            console.info(f"failed: {failure}")
        raise typer.Exit(9)


def _table(
    sweeps: list[Sweep],
    points: list[Point | None],
    summaries: list[dict[str, Any]],
    rival: list[dict[str, Any]],
    against: str | None,
    metric: str,
) -> None:
    from rlcli.cli.eval import interval
    from rlcli.rl.heat_map import number

    columns = [*(sweep.name for sweep in sweeps), metric.upper(), "95 % INTERVAL"]
    columns += ["RETURN"] if metric != "return" else []
    columns += [f"{against} {metric}".upper(), "95 % INTERVAL"] if rival else []
    rows = []
    for place, (at, summary) in enumerate(zip(points, summaries, strict=True)):
        row = ["as it is"] * len(sweeps) if at is None else [number(value) for value in at]
        row += [f"{_middle(summary[metric]):.4f}", interval(summary[metric])]
        row += [f"{summary['return']['mean']:.4f}"] if metric != "return" else []
        if rival:
            row += [f"{_middle(rival[place][metric]):.4f}", interval(rival[place][metric])]
        rows.append(row)
    console.table(columns, rows)


def _one_scale(maps: list[HeatMap], metric: str) -> list[HeatMap]:
    """Maps beside each other have one scale of colours: shares that from 0 to 1."""
    from dataclasses import replace

    low, high = (0.0, 1.0) if metric == "success" else (min(m.low for m in maps), max(m.high for m in maps))
    return [replace(drawn, low=low, high=high) for drawn in maps]


def _middle(value: dict[str, Any]) -> float:
    return value["rate"] if "rate" in value else value["mean"]


def _said(value: dict[str, Any]) -> str:
    from rlcli.cli.eval import interval

    return f"{_middle(value):.4f} ({interval(value)})"


def _named(sweeps: list[Sweep], at: Point) -> dict[str, float]:
    return {sweep.name: value for sweep, value in zip(sweeps, at, strict=True)}


def _at(sweeps: list[Sweep], at: Point) -> str:
    from rlcli.rl.heat_map import number

    return ", ".join(f"{name} {number(value)}" for name, value in _named(sweeps, at).items())

"""`rlcli eval`: how good a policy is, with intervals, and whether it is good enough."""

from __future__ import annotations

import math
from typing import Annotated, Any

import typer

from rlcli.cli.console import console
from rlcli.cli.options import (
    CheckpointRef,
    ConfigFile,
    Debug,
    Headless,
    Json,
    NumEnvs,
    Overrides,
    Quiet,
    Record,
    RecordMode,
    RunsDir,
    Seed,
    draw_seed,
)


def command(
    task: Annotated[
        str | None, typer.Argument(help="A task: its newest run is evaluated. Not needed with --checkpoint.")
    ] = None,
    overrides: Overrides = None,
    checkpoint: CheckpointRef = None,
    policy: Annotated[str, typer.Option("--policy", help="trained, zero or random.")] = "trained",
    episodes: Annotated[
        int, typer.Option("--episodes", min=1, help="Episodes to run, each environment's first ones.")
    ] = 200,
    fail_under: Annotated[
        list[str] | None,
        typer.Option("--fail-under", help="success=0.99, return=4 or length=250: exit 9 below; repeatable."),
    ] = None,
    stochastic: Annotated[bool, typer.Option("--stochastic", help="Sample actions as in training.")] = False,
    record: Record = None,
    record_mode: RecordMode = "all",
    num_envs: NumEnvs = None,
    seed: Seed = 42,
    config: ConfigFile = None,
    runs_dir: RunsDir = None,
    json: Json = False,
    quiet: Quiet = False,
    debug: Debug = False,
    headless: Headless = True,
) -> None:
    """Evaluate a policy."""
    from rlcli.cli.session import check_record, open_session
    from rlcli.errors import UsageError

    console.quiet = quiet
    limits = _limits(fail_under or [])

    def check(resolved: Any) -> None:
        if "success" in limits and resolved.task.success is None:
            raise UsageError("this task defines no success", hint="add `success:` to its YAML, or use return=X")

    check_record(record, record_mode)
    session = open_session(
        task,
        overrides or [],
        checkpoint=checkpoint,
        policy=policy,
        stochastic=stochastic,
        num_envs=num_envs,
        seed=draw_seed(seed),
        config=config,
        runs_dir=runs_dir,
        check=check,
    )
    from rlcli.cli.session import run_episodes

    summary, recorded = run_episodes(session, episodes, record, record_mode)
    failures = _verdict(summary, limits)
    _show(summary)
    console.document(
        "eval",
        checkpoint=str(session.checkpoint) if session.checkpoint else None,
        policy=policy,
        stochastic=stochastic,
        **summary,
        passed=not failures,
        failures=failures,
        recorded=recorded,
    )
    if failures:
        for failure in failures:
            console.info(f"failed: {failure}")
        raise typer.Exit(9)


def _limits(texts: list[str]) -> dict[str, float]:
    from rlcli.errors import UsageError

    limits = {}
    for text in texts:
        key, equals, value = text.partition("=")
        try:
            if not equals or key not in ("success", "return", "length"):
                raise ValueError
            limits[key] = float(value)
            if not math.isfinite(limits[key]):
                raise ValueError
        except ValueError:
            raise UsageError(f"--fail-under '{text}' is not success=X, return=X or length=X") from None
    return limits


def _verdict(summary: dict[str, Any], limits: dict[str, float]) -> list[str]:
    failures = []
    for key, limit in limits.items():
        value = summary["success"]["rate"] if key == "success" else summary[key]["mean"]
        if value < limit:
            failures.append(f"{key} is {value:.6g}, below {limit:g}")
    return failures


def _show(summary: dict[str, Any]) -> None:
    rows = [["episodes", str(summary["episodes"]), ""]]
    if "success" in summary:
        s = summary["success"]
        rows.append(["success rate", f"{s['rate']:.4f}", f"{s['low']:.4f} .. {s['high']:.4f}"])
    for key, label in (("return", "return"), ("length", "length [steps]")):
        value = summary[key]
        rows.append([label, f"{value['mean']:.4f}", f"{value['low']:.4f} .. {value['high']:.4f}"])
    rows += [[f"reward {name}", f"{value:.4f}", ""] for name, value in summary["reward_terms"].items()]
    rows += [[f"ended by {name}", f"{value:.2%}", ""] for name, value in summary["terminations"].items()]
    if summary["diverged"]:
        causes = ", ".join(f"{cause} {count}" for cause, count in summary["diverged_by"].items())
        rows.append(["diverged", str(summary["diverged"]), causes])
    console.table(["", "MEAN", "95 % INTERVAL"], rows)

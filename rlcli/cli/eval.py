"""`rlcli eval`: how good a policy is, with intervals, and whether it is good enough."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any

import typer

from rlcli.cli.console import SCHEMA_VERSION, console
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

_LABELS = {"return": "return", "length": "length [steps]"}
_LIMIT = re.compile(r"(?:success|return|length)(?:\.low)?|(?:reward_terms|terminations)\.\S+")


def command(
    task: Annotated[
        str | None, typer.Argument(help="A task: its newest run is evaluated. Not needed with --checkpoint.")
    ] = None,
    overrides: Overrides = None,
    compare: Annotated[
        bool,
        typer.Option(
            "--compare",
            help="RUN1 RUN2 [...] in the same episodes: eval --compare A B; beside a run also lqr, zero or random."
            " --fail-under is of the first.",
        ),
    ] = False,
    checkpoint: CheckpointRef = None,
    policy: Annotated[str, typer.Option("--policy", help="trained, zero, random or lqr.")] = "trained",
    episodes: Annotated[
        int, typer.Option("--episodes", min=1, help="Episodes to run, each environment's first ones.")
    ] = 200,
    fail_under: Annotated[
        list[str] | None,
        typer.Option(
            "--fail-under",
            help="success=0.99, return=4, length=250, reward_terms.NAME=X or terminations.NAME=X: exit 9 below;"
            " success.low=0.99 and the like: of the interval's lower end; repeatable.",
        ),
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

    console.quiet = quiet
    limits = read_limits(fail_under or [])
    if compare:
        from rlcli.cli.compare import compare as compared
        from rlcli.errors import UsageError

        if checkpoint is not None or policy != "trained" or record is not None:
            raise UsageError("--compare takes its policies as words: eval --compare RUN1 RUN2")
        failures = compared(
            [*([] if task is None else [task]), *(overrides or [])],
            limits=limits,
            episodes=episodes,
            stochastic=stochastic,
            num_envs=num_envs,
            seed=draw_seed(seed),
            config=config,
            runs_dir=runs_dir,
        )
        _conclude(failures)
        return

    def check(resolved: Any) -> None:
        require_success(resolved, limits)

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
    failures = verdict(summary, limits)
    show_summary(summary)
    said = {
        "checkpoint": str(session.checkpoint) if session.checkpoint else None,
        "policy": policy,
        "stochastic": stochastic,
        "seed": session.seed,
        "num_envs": session.env.num_envs,
        **summary,
    }
    if not stochastic and session.as_trained:
        keep(session, said)
    console.document("eval", **said, passed=not failures, failures=failures, recorded=recorded)
    _conclude(failures)


def _conclude(failures: list[str]) -> None:
    for failure in failures:
        console.info(f"failed: {failure}")
    if failures:
        raise typer.Exit(9)


def read_limits(texts: list[str]) -> dict[str, float]:
    """`KEY=X` of --fail-under, by key.

    Raises:
        UsageError: for anything else.
    """
    from rlcli.errors import UsageError

    limits = {}
    for text in texts:
        key, equals, value = text.partition("=")
        try:
            if not equals or not _LIMIT.fullmatch(key):
                raise ValueError
            limits[key] = float(value)
            if not math.isfinite(limits[key]):
                raise ValueError
        except ValueError:
            raise UsageError(
                f"--fail-under '{text}' is not success=X, return=X or length=X",
                hint="also reward_terms.NAME=X, terminations.NAME=X; KEY.low=X is of the interval's lower end",
            ) from None
    return limits


def require_success(resolved: Any, limits: dict[str, float]) -> None:
    """What a limit is about must be there to be judged.

    Raises:
        UsageError: if a task without success is judged by it.
    """
    from rlcli.errors import UsageError

    if any(key.partition(".")[0] == "success" for key in limits) and resolved.task.success is None:
        raise UsageError("this task defines no success", hint="add `success:` to its YAML, or use return=X")


def verdict(summary: dict[str, Any], limits: dict[str, float]) -> list[str]:
    """What lies below its limit, in words.

    Raises:
        UsageError: for a term that there is not.
    """
    failures = []
    for key, limit in limits.items():
        value = value_of(summary, key)
        if value is None:
            failures.append(f"{key} is not known from one episode, and {limit:g} is asked for")
        elif value < limit:
            failures.append(f"{key} is {value:.6g}, below {limit:g}")
    return failures


def value_of(summary: dict[str, Any], key: str) -> float | None:
    """The number that a key of --fail-under stands for; None where it is not known.

    Raises:
        UsageError: for a term that there is not.
    """
    from rlcli.errors import UsageError, did_you_mean, listing

    head, _, rest = key.partition(".")
    found = summary[head]
    if head in ("reward_terms", "terminations"):
        name = rest if rest in found else rest.removesuffix(".low")
        if name not in found:
            near = did_you_mean(name, found)
            raise UsageError(f"--fail-under: there is no {head}.{name}", hint=near or f"there are: {listing(found)}")
        found, rest = found[name], "low" if name != rest else ""
    return found["low"] if rest else found["rate" if "rate" in found else "mean"]


def show_summary(summary: dict[str, Any]) -> None:
    """The summary of an evaluation, as a table."""
    rows = [["episodes", str(summary["episodes"]), ""]]
    if "success" in summary:
        rows.append(["success rate", f"{summary['success']['rate']:.4f}", interval(summary["success"])])
    rows += [[label, f"{summary[key]['mean']:.4f}", interval(summary[key])] for key, label in _LABELS.items()]
    rows += [[f"reward {name}", f"{v['mean']:.4f}", interval(v)] for name, v in summary["reward_terms"].items()]
    rows += [[f"ended by {name}", f"{v['rate']:.4f}", interval(v)] for name, v in summary["terminations"].items()]
    rows += [[f"mean {name}", f"{v['mean']:.4f}", interval(v)] for name, v in summary["metrics"].items()]
    if summary["diverged"]:
        causes = ", ".join(f"{cause} {count}" for cause, count in summary["diverged_by"].items())
        rows.append(["diverged", str(summary["diverged"]), causes])
    console.table(["", "MEAN", "95 % INTERVAL"], rows)


def interval(value: dict[str, Any]) -> str:
    """The interval of a mean or a share, as text."""
    if value["low"] is None:
        return "unknown"
    return f"{value['low']:.4f} .. {value['high']:.4f}"


def keep(session: Any, document: dict[str, Any]) -> None:
    """Leave the document in the run, for whoever reports on it; a run that cannot be written to stays as it is."""
    from rlcli.errors import CheckpointError, MachineError
    from rlcli.rl.evaluations import keep_evaluation

    try:
        file = keep_evaluation(
            session.run, session.checkpoint.name, {"schema": SCHEMA_VERSION, "command": "eval", **document}
        )
    except (CheckpointError, MachineError) as error:
        console.warn(f"the evaluation is not kept in the run: {error.message}")
        return
    console.detail(f"kept in {file}")

"""`rlcli eval`: how good a policy is, with intervals, and whether it is good enough."""

from __future__ import annotations

import difflib
import math
import re
from typing import Annotated, Any

import typer

from rlcli.cli.completion import tasks, words
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
    Verbose,
    draw_seed,
)

_LABELS = {"return": "return", "length": "length [steps]"}
_KEYS = ("success", "return", "length")
_GROUPS = ("reward_terms", "terminations", "values")
_WORD = re.compile(r"[A-Za-z_][\w./-]*")


def command(
    task: Annotated[
        str | None,
        typer.Argument(
            autocompletion=tasks,
            help="A task: its newest run is evaluated, else the policy it ships. Not needed with --checkpoint.",
        ),
    ] = None,
    overrides: Overrides = None,
    compare: Annotated[
        bool,
        typer.Option(
            "--compare",
            help="RUN1 RUN2 [...] in the same episodes: eval --compare A B; beside a run also shipped, lqr, zero or"
            " random. --fail-under and --fail-over are of the first.",
        ),
    ] = False,
    checkpoint: CheckpointRef = None,
    policy: Annotated[
        str,
        typer.Option(
            "--policy", autocompletion=words("trained", "zero", "random", "lqr"), help="trained, zero, random or lqr."
        ),
    ] = "trained",
    episodes: Annotated[
        int, typer.Option("--episodes", min=1, help="Episodes to run, each environment's first ones.")
    ] = 200,
    fail_under: Annotated[
        list[str] | None,
        typer.Option(
            "--fail-under",
            help="success=0.99, return=4, length=250, reward_terms.NAME=X, terminations.NAME=X, or a value of the task"
            " (speed=5): exit 9 below; success.low=0.99 and the like: of the interval's lower end; repeatable.",
        ),
    ] = None,
    fail_over: Annotated[
        list[str] | None,
        typer.Option(
            "--fail-over",
            help="The same names, error_vel_xy=0.25: exit 9 above; KEY.high=X: of the interval's upper end;"
            " repeatable.",
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
    verbose: Verbose = False,
    debug: Debug = False,
    headless: Headless = True,
) -> None:
    """Evaluate a policy."""
    from rlcli.cli.session import check_record, open_session

    limits, ceilings = read_limits(fail_under or []), read_limits(fail_over or [], "--fail-over")
    if compare:
        from rlcli.cli.compare import compare as compared
        from rlcli.errors import UsageError

        if checkpoint is not None or policy != "trained" or record is not None:
            raise UsageError("--compare takes its policies as words: eval --compare RUN1 RUN2")
        failures = compared(
            [*([] if task is None else [task]), *(overrides or [])],
            limits=limits,
            ceilings=ceilings,
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
        require_success(resolved, limits | ceilings)

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
    failures = verdict(summary, limits, ceilings)
    show_summary(summary)
    said = {
        "checkpoint": str(session.checkpoint) if session.checkpoint else None,
        "chosen": session.chosen,
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


def read_limits(texts: list[str], flag: str = "--fail-under") -> dict[str, float]:
    """`KEY=X` of --fail-under or --fail-over, by key.

    Raises:
        UsageError: for anything else.
    """
    from rlcli.errors import UsageError

    limits = {}
    for text in texts:
        key, equals, value = text.partition("=")
        try:
            if not equals or not _is_key(key, flag):
                raise ValueError
            limits[key] = float(value)
            if not math.isfinite(limits[key]):
                raise ValueError
        except ValueError:
            end = "low" if flag == "--fail-under" else "high"
            raise UsageError(
                f"{flag} '{text}' is not success=X, return=X, length=X or NAME=X",
                hint="NAME: a value of the task, reward_terms.NAME or terminations.NAME; KEY." + end + "=X is of the"
                f" interval's {'lower' if end == 'low' else 'upper'} end",
            ) from None
    return limits


def _is_key(key: str, flag: str) -> bool:
    """Whether this may stand for a number; whether the task has a value of that name, an evaluation shows."""
    head, _, end = key.partition(".")
    if head in _KEYS:
        return end == "" or end == ("low" if flag == "--fail-under" else "high")
    if head in _GROUPS:
        return bool(end) and not any(letter.isspace() for letter in end)
    return bool(_WORD.fullmatch(key)) and not difflib.get_close_matches(head, _KEYS, cutoff=0.8)


def require_success(resolved: Any, limits: dict[str, float]) -> None:
    """What a limit is about must be there to be judged.

    Raises:
        UsageError: if a task without success is judged by it.
    """
    from rlcli.errors import UsageError

    if any(key.partition(".")[0] == "success" for key in limits) and resolved.task.success is None:
        raise UsageError("this task defines no success", hint="add `success:` to its YAML, or use return=X")


def verdict(summary: dict[str, Any], limits: dict[str, float], ceilings: dict[str, float] | None = None) -> list[str]:
    """What lies below its limit or above its ceiling, in words.

    Raises:
        UsageError: for a term or a value that there is not.
    """
    failures = []
    both = [(key, limit, "below") for key, limit in limits.items()]
    both += [(key, limit, "above") for key, limit in (ceilings or {}).items()]
    for key, limit, side in both:
        value = value_of(summary, key, limit, "--fail-under" if side == "below" else "--fail-over")
        if value is None:
            failures.append(f"{key} is not known from one episode, and {limit:g} is asked for")
        elif value < limit if side == "below" else value > limit:
            failures.append(f"{key} is {value:.6g}, {side} {limit:g}")
    return failures


def value_of(summary: dict[str, Any], key: str, limit: float = 0.0, flag: str = "--fail-under") -> float | None:
    """The number that a key of --fail-under or --fail-over stands for; None where it is not known.

    Raises:
        UsageError: for a term or a value that there is not.
    """
    head, _, rest = key.partition(".")
    end = "low" if flag == "--fail-under" else "high"
    if head in _KEYS:
        found = summary[head]
    else:
        group, rest = (head, rest) if head in _GROUPS else ("values", key)
        name = _name_in(summary[group], rest) or _name_in(summary[group], rest.removesuffix(f".{end}"))
        if name is None:
            raise _no_such(summary, group, rest.removesuffix(f".{end}"), f"{flag} {key}={limit:g}")
        found, rest = summary[group][name], "" if _name_in(summary[group], rest) else end
    return found[end] if rest else found["rate" if "rate" in found else "mean"]


def _name_in(found: dict[str, Any], name: str) -> str | None:
    """The entry of this name; of values of commands, `command/metric`, the last part alone where it tells which."""
    if name in found:
        return name
    same = [entry for entry in found if entry.rpartition("/")[2] == name]
    return same[0] if len(same) == 1 else None


def _no_such(summary: dict[str, Any], group: str, name: str, text: str) -> Exception:
    from rlcli.errors import UsageError, did_you_mean, listing

    found = summary[group]
    if group == "values":
        names = [*_KEYS, *found]
        same = [entry for entry in found if entry.rpartition("/")[2] == name]
        if same:
            return UsageError(f"{text}: which of them?", hint=listing(same))
        hint = did_you_mean(name, names) or f"there are: {listing(names)}"
        return UsageError(f"{text}: the task logs no value '{name}'", hint=hint)
    near = did_you_mean(name, found)
    return UsageError(f"{text}: there is no {group}.{name}", hint=near or f"there are: {listing(found)}")


def show_summary(summary: dict[str, Any]) -> None:
    """The summary of an evaluation, as a table."""
    rows = [["episodes", str(summary["episodes"]), ""]]
    if "success" in summary:
        rows.append(["success rate", f"{summary['success']['rate']:.4f}", interval(summary["success"])])
    rows += [[label, f"{summary[key]['mean']:.4f}", interval(summary[key])] for key, label in _LABELS.items()]
    rows += [[f"reward {name}", f"{v['mean']:.4f}", interval(v)] for name, v in summary["reward_terms"].items()]
    rows += [[f"value {name}", _number(v["mean"]), interval(v)] for name, v in summary["values"].items()]
    rows += [[f"ended by {name}", f"{v['rate']:.4f}", interval(v)] for name, v in summary["terminations"].items()]
    if summary["diverged"]:
        causes = ", ".join(f"{cause} {count}" for cause, count in summary["diverged_by"].items())
        rows.append(["diverged", str(summary["diverged"]), causes])
    console.table(["", "MEAN", "95 % INTERVAL"], rows)


def _number(value: float | None) -> str:
    return "not finite" if value is None else f"{value:.4f}"


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

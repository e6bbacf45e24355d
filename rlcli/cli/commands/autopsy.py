"""Command `rlcli autopsy`: list and inspection of the failed and outlier episodes that a training recorded.

It reads the recordings in the folder of the run, and can render one of them as a video.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import RunRef, RunsDir, TaskFolder, choice, video_file
from rlcli.errors import RlcliError, UsageError, require_known
from rlcli.registry.find import path_of

if TYPE_CHECKING:
    from rlcli.registry import TaskSource
    from rlcli.replay.failure_cases import Contact, FailureCase
    from rlcli.runs.run import Run

_BARS = "▁▂▃▄▅▆▇█"
_WIDTH = 48
"""Number of bars in one sparkline."""
_SORT_KEYS: dict[str, Callable[[FailureCase], Any]] = {
    "when": lambda case: 0,  # the cases are in the order of training; sorting is stable
    "return": lambda case: case.episode.total_reward,
    "length": lambda case: case.episode.length,
    "kind": lambda case: (case.failure.kind, case.ended_by),
}
_MAX_COLUMNS = 12
"""Number of columns of observations that are printed at most; the same limit holds for actions and reward terms."""


def command(
    run: RunRef,
    case: Annotated[int | None, typer.Argument(min=0)] = None,
    sort: Annotated[str, choice("ORDER", *_SORT_KEYS)] = "when",
    steps: Annotated[int, typer.Option(min=1)] = 8,
    video: Annotated[Path | None, typer.Option(metavar="FILE")] = None,
    task: TaskFolder = None,
    runs_dir: RunsDir = None,
) -> None:
    """List or show the recorded failed and outlier episodes of a training.

    Options:
        case: Show this case, by its number in the list, from 0. [default: list all]
        sort: Order of the list: when (oldest first), return, length or kind (why it was recorded).
        steps: Number of steps at the end of the case to show.
        video: Render the last seconds of the case to FILE.mp4 or FILE.gif. Without FILE: autopsy.mp4.

    Examples:
        rlcli autopsy latest --sort return
            List the recorded episodes of the newest run, worst return first.
        rlcli autopsy latest 0 --video case.mp4
            Show the first case and render its last seconds.
    """
    require_known(sort, list(_SORT_KEYS), "--sort", "orders")
    if video is not None and case is None:
        raise UsageError(
            "--video needs the number of a recorded episode",
            hint="rlcli autopsy RUN lists the episodes; rlcli autopsy RUN N --video FILE.mp4 renders one",
        )
    video = video_file(video, "autopsy.mp4")
    from rlcli.replay.failure_cases import list_failure_cases, why_no_cases
    from rlcli.runs.policy_bundle import is_bundle
    from rlcli.runs.run_ref import default_runs_dir, find_run
    from rlcli.runs.trusted_tasks import named_task

    named = None if task is None else named_task(task)
    if is_bundle(path_of(run)):
        _refuse_bundle(run, case)
        return
    found, why = find_run(run, runs_dir or default_runs_dir())
    console.info(f"run {found.folder} ({why})")
    cases = list_failure_cases(found)
    if case is None:
        _print_list(found, cases, sort)
    elif case < len(cases):
        _print_case(found, cases[case], case, steps, video, named)
    else:
        hint = f"give a number from 0 to {len(cases) - 1}" if cases else why_no_cases(found)
        raise UsageError(f"{found.folder} has no recorded episode {case}", hint=hint)


def _refuse_bundle(folder: str, case: int | None) -> None:
    """Print that an exported bundle has no recorded episodes.

    Args:
        folder: the folder of the bundle.
        case: number of the recorded episode on the command line; None: the command has to list all.

    Raises:
        UsageError: if `case` is given.
    """
    from rlcli.runs.policy_bundle import open_bundle

    open_bundle(Path(folder))
    why = (
        "a bundle holds a policy, not the recorded episodes of its training; to record new ones, run"
        f" `rlcli eval --checkpoint {folder} --record FILE --record-mode failed`"
    )
    if case is not None:
        raise UsageError(f"{folder} has no recorded episode {case}", hint=why)
    _print_no_cases(folder, why)


def _print_no_cases(folder: str, why: str) -> None:
    console.info(f"no episode was recorded: {why}")
    console.document("autopsy", run=folder, cases=[], why_none=why)


def _print_list(run: Run, cases: list[FailureCase], sort: str) -> None:
    """Print a table of the recorded episodes of a run, or why there are none.

    Args:
        run: the run.
        cases: its recorded episodes, in the order of training.
        sort: key of `_SORT_KEYS`: the order of the rows.
    """
    from rlcli.replay.failure_cases import why_no_cases

    if not cases:
        _print_no_cases(str(run.folder), why_no_cases(run))
        return
    rows = sorted(enumerate(cases), key=lambda row: _SORT_KEYS[sort](row[1]))
    columns = ["CASE", "ITERATION", "STEP", "ENV", "EPISODE", "LENGTH", "RETURN", "KEPT FOR", "ENDED BY", "RECORDED"]
    console.table(columns, [[str(number), *_row(case)] for number, case in rows])
    listed = [{"case": number, **case.record()} for number, case in rows]
    console.document("autopsy", run=str(run.folder), cases=listed, why_none=None)


def _row(case: FailureCase) -> list[str]:
    episode, failure = case.episode, case.failure
    numbers = (failure.iteration, failure.step, episode.env, episode.index, episode.length)
    return [*map(str, numbers), f"{episode.total_reward:.6g}", failure.kind, case.ended_by, f"{case.seconds:.3g} s"]


def _print_case(
    run: Run, case: FailureCase, number: int, steps: int, video: Path | None, named: TaskSource | None
) -> None:
    """Print one recorded episode: what ended it, its rewards, last steps and contacts; render it with --video.

    Contacts and video need the task's model. If the task cannot be imported, the contacts are left out with a
    message, and --video is an error.
    """
    from rlcli.replay.failure_cases import stage_case

    staged, error = None, None
    try:
        staged = stage_case(case, named)
    except RlcliError as raised:
        if video is not None:
            raise
        error = raised
    _print_facts(case, number)
    _print_rewards(case)
    _print_steps(case, steps)
    contacts = None if staged is None else staged.contacts()
    if contacts is not None:
        _print_contacts(contacts)
    frames = 0
    if staged is not None and video is not None:
        from rlcli.viewer.record_video import film_case

        frames, fps, backend = film_case(staged, video)
        console.info(f"{frames} frames at {fps:g} per second, rendered with {backend}")
        console.data(str(video))
    if error is not None:
        console.info(f"contacts cannot be shown: {error.message}{f'; {error.hint}' if error.hint else ''}")
    console.document(
        "autopsy",
        run=str(run.folder),
        case=number,
        **case.record(),
        **case.series(),
        contacts=None if contacts is None else [asdict(contact) for contact in contacts],
        no_contacts=None if error is None else error.message,
        same_model=None if staged is None else staged.staged.same_model,
        video=video,
        frames=frames,
    )


def _print_facts(case: FailureCase, number: int) -> None:
    episode, failure, usual = case.episode, case.failure, case.failure.usual_returns
    step_dt = case.trajectory.header.step_dt
    console.data(
        f"case {number}: environment {episode.env}, episode {episode.index}, ended in iteration {failure.iteration}"
        f" (step {failure.step}) after {episode.length} steps, {episode.length * step_dt:.3g} s"
    )
    others = "" if usual is None else f"; interquartile range of earlier episodes: {usual[0]:.6g} .. {usual[1]:.6g}"
    console.data(f"return {episode.total_reward:.6g}{others}")
    console.data(f"kept for: {failure.kind}; ended by: {case.ended_by}")
    if case.world.diverged_at is not None:
        console.data(f"  {case.world.diverged_at}")
    console.data(f"recorded: its last {episode.kept} steps, {case.seconds:.3g} s; rlcli replay {case.trajectory.file}")


def _print_rewards(case: FailureCase) -> None:
    """Print one row for each reward term and for the reward: its curve over the recorded steps, and statistics."""
    console.data("")
    rows = []
    for name, values in [*case.columns("reward_terms").items(), ("reward", case.values("rewards"))]:
        numbers = (values.sum(), values.min(), values.max(), values[-1])
        rows.append([name, sparkline(values.tolist()), *(f"{x:.4g}" for x in numbers)])
    times = case.times
    console.table(["REWARD PER STEP", f"{times[0]:.3g} .. {times[-1]:.3g} s", "SUM", "MIN", "MAX", "LAST"], rows)


def _print_steps(case: FailureCase, steps: int) -> None:
    """Print observations, actions and rewards of the last `steps` recorded steps, one column per step."""
    kept, times = case.episode.kept, case.times
    last = range(max(0, kept - steps), kept)
    rows = [["", "end of step [s]", *(f"{times[i]:.4g}" for i in last)]]
    hidden = 0
    for word, part in (("obs", "observations"), ("action", "actions"), ("reward", "reward_terms")):
        columns = list(case.columns(part).items())
        rows += [[word, name, *(f"{values[i]:.4g}" for i in last)] for name, values in columns[:_MAX_COLUMNS]]
        hidden += len(columns[_MAX_COLUMNS:])
    rows.append(["reward", "total", *(f"{case.values('rewards')[i]:.4g}" for i in last)])
    console.data("")
    console.table(["", "", *(f"{i - kept + 1}" for i in last)], rows)
    if hidden:
        console.info(f"further columns, shown with --json: {hidden}")


def _print_contacts(contacts: Sequence[Contact]) -> None:
    console.data("")
    if not contacts:
        console.data("contacts at the end: none")
        return
    rows = [[*c.geoms, f"{1e3 * c.distance:.3f}", f"{c.force:.4g}"] for c in contacts[: 2 * _MAX_COLUMNS]]
    console.table(["CONTACT AT THE END", "", "DISTANCE [mm]", "FORCE [N]"], rows)
    if len(contacts) > 2 * _MAX_COLUMNS:
        console.info(f"further contacts, shown with --json: {len(contacts) - 2 * _MAX_COLUMNS}")


def sparkline(values: Sequence[float], width: int = _WIDTH) -> str:
    """Return values as a line of at most `width` bars of eight heights; `?` for a value that is not finite.

    If there are more than `width` values, each bar shows the mean of several adjacent values.
    """
    if len(values) > width:
        edges = [round(i * len(values) / width) for i in range(width + 1)]
        values = [sum(values[a:b]) / (b - a) for a, b in itertools.pairwise(edges)]
    finite = [value for value in values if math.isfinite(value)]
    low, high = min(finite, default=0.0), max(finite, default=0.0)
    span = high - low

    def bar(value: float) -> str:
        if not math.isfinite(value):
            return "?"
        return _BARS[round((len(_BARS) - 1) * (value - low) / span) if span > 0 else 3]

    return "".join(map(bar, values))

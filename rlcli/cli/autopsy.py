"""`rlcli autopsy`: how the episodes of a training ended that ended badly, or unlike the others."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.completion import runs
from rlcli.cli.console import console
from rlcli.cli.options import CHOOSE, Debug, Json, Quiet, RunsDir, Verbose

if TYPE_CHECKING:
    from rlcli.registry import TaskSource
    from rlcli.rl.cases import Case, Scene

_BARS = "▁▂▃▄▅▆▇█"
_WIDTH = 48
_SORTS = ("when", "return", "length", "kind")
_MANY = 12


def command(
    run: Annotated[str, typer.Argument(autocompletion=runs, help="A run: its folder, its name, or latest.")],
    case: Annotated[int | None, typer.Argument(help="Show this case, by its number in the list.", min=0)] = None,
    sort: Annotated[str, typer.Option("--sort", help="Order of the list: when, return, length or kind.")] = "when",
    steps: Annotated[int, typer.Option("--steps", min=1, help="How many last steps of a case to show.")] = 8,
    video: Annotated[
        Path | None, typer.Option("--video", help="Draw the case's last seconds to FILE.mp4 or FILE.gif.")
    ] = None,
    task: Annotated[
        str | None, typer.Option("--task", help="Where the code of a task that is not installed lies now: its folder.")
    ] = None,
    runs_dir: RunsDir = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """List or show how kept episodes ended."""
    from rlcli.errors import UsageError, did_you_mean

    if sort not in _SORTS:
        raise UsageError(
            f"--sort {sort}: there is no such order", hint=did_you_mean(sort, _SORTS) or f"orders: {', '.join(_SORTS)}"
        )
    if video is not None:
        from rlcli.viewer.writer import check_video

        if case is None:
            raise UsageError("--video draws one case", hint="rlcli autopsy RUN N --video FILE.mp4")
        video = Path("autopsy.mp4") if str(video) == CHOOSE else video
        check_video(video)
    from rlcli.rl.cases import list_cases
    from rlcli.rl.run import default_runs_dir, find_run
    from rlcli.rl.trust import named_task

    named = None if task is None else named_task(task)
    if _is_bundle(run):
        _refuse_bundle(run, case)
        return
    found, why = find_run(run, runs_dir or default_runs_dir())
    console.info(f"run {found.folder} ({why})")
    cases = list_cases(found, console.warn)
    if case is None:
        _list(found, cases, sort)
        return
    if case >= len(cases):
        hint = f"it has {len(cases)}, counted from 0" if cases else _why_none(found)
        raise UsageError(f"no case {case} in {found.folder}", hint=hint)
    _show(found, cases[case], case, steps, video, named)


def _is_bundle(word: str) -> bool:
    from rlcli.rl.bundle import is_bundle

    return is_bundle(Path(word))


def _refuse_bundle(folder: str, case: int | None) -> None:
    """A policy without its training has no episodes of it."""
    from rlcli.errors import UsageError
    from rlcli.rl.bundle import open_bundle

    open_bundle(Path(folder))
    why = (
        f"it is a policy without its training; rlcli eval --checkpoint {folder} --record FILE --record-mode failed"
        " keeps episodes of it"
    )
    if case is not None:
        raise UsageError(f"no case {case} in {folder}", hint=why)
    console.info(f"no episode was kept: {why}")
    console.document("autopsy", run=folder, cases=[], why_none=why)


def _list(run: Any, cases: list[Case], sort: str) -> None:
    keys: dict[str, Any] = {
        "when": lambda row: row[0],
        "return": lambda row: (row[1].ending.total_reward, row[0]),
        "length": lambda row: (row[1].ending.length, row[0]),
        "kind": lambda row: (row[1].ending.kind, row[1].ended_by, row[0]),
    }
    rows = sorted(enumerate(cases), key=keys[sort])
    if not cases:
        console.info(f"no episode was kept: {_why_none(run)}")
    else:
        columns = ["CASE", "ITERATION", "STEP", "ENV", "EPISODE", "LENGTH", "RETURN", "KEPT FOR", "ENDED BY", "HELD"]
        console.table(columns, [[str(number), *_row(case)] for number, case in rows])
    listed = [{"case": number, **case.record()} for number, case in rows]
    console.document("autopsy", run=str(run.folder), cases=_plain(listed), why_none=None if cases else _why_none(run))


def _row(case: Case) -> list[str]:
    ending = case.ending
    return [
        str(ending.iteration),
        str(ending.step),
        str(case.env),
        str(ending.episode),
        str(ending.length),
        f"{ending.total_reward:.6g}",
        ending.kind,
        case.ended_by,
        f"{case.steps * ending.step_dt:.3g} s",
    ]


def _why_none(run: Any) -> str:
    device = str(run.record.get("device", "cpu"))
    if device.startswith("cuda"):
        return (
            f"it was trained on {device}, where a step cannot be stepped again; rlcli eval --checkpoint RUN --record"
            " FILE --record-mode failed keeps episodes of its policy"
        )
    return "training keeps some as they end (agent.autopsy), and writes them with each checkpoint"


def _show(run: Any, case: Case, number: int, steps: int, video: Path | None, named: TaskSource | None) -> None:
    from rlcli.errors import RlcliError

    scene, unseen = None, None
    try:
        scene = _restage(case, named)
    except RlcliError as error:
        if video is not None:
            raise
        unseen = error
    _tell_facts(case, number)
    _tell_rewards(case)
    _tell_steps(case, steps)
    contacts = None if scene is None else scene.contacts()
    if contacts is not None:
        _tell_contacts(case, contacts)
    frames = _draw(case, scene, video) if scene is not None and video is not None else 0
    if unseen is not None:
        console.info(f"no contacts: {unseen.message}{f'; {unseen.hint}' if unseen.hint else ''}")
    ending = case.ending
    console.document(
        "autopsy",
        run=str(run.folder),
        case=number,
        **_plain(case.record()),
        time=_plain(case.times.tolist()),
        reward=_plain(case.reward.tolist()),
        reward_terms={n: _plain(case.reward_terms[:, i].tolist()) for i, n in enumerate(ending.reward_terms)},
        observations={n: _plain(case.observations[:, i].tolist()) for i, n in enumerate(ending.observations)},
        actions={n: _plain(case.actions[:, i].tolist()) for i, n in enumerate(ending.actions)},
        contacts=None
        if contacts is None
        else [
            {"geoms": list(c.geoms), "distance": c.distance, "force": c.force, "position": list(c.position)}
            for c in contacts
        ],
        no_contacts=None if unseen is None else unseen.message,
        same_model=None if scene is None else scene.staged.same_model,
        video=None if video is None else str(video),
        frames=frames,
    )


def _restage(case: Case, named: TaskSource | None) -> Scene:
    import torch

    from rlcli.rl.cases import restage

    torch.set_num_threads(1)
    scene = restage(case, named)
    if not scene.staged.same_model:
        console.warn("the installed task's model is not the one of the training: contacts and pictures are of today's")
    return scene


def _tell_facts(case: Case, number: int) -> None:
    ending = case.ending
    console.data(
        f"case {number}: environment {case.env}, episode {ending.episode}, ended in iteration {ending.iteration}"
        f" (step {ending.step}) after {ending.length} steps, {ending.length * ending.step_dt:.3g} s"
    )
    usual = "" if ending.usual is None else f"; half of the others: {ending.usual[0]:.6g} .. {ending.usual[1]:.6g}"
    console.data(f"return {ending.total_reward:.6g}{usual}")
    console.data(f"kept for: {ending.kind}; ended by: {case.ended_by}")
    where = case.dump.document.lives[0].where
    if where is not None:
        console.data(f"  {where}")
    held = f"its last {case.steps} steps, {case.steps * ending.step_dt:.3g} s"
    console.data(f"held: {held}; rlcli replay {case.dump.file} steps them again")


def _tell_rewards(case: Case) -> None:
    """Each term over the kept steps."""
    console.data("")
    series = [(name, case.reward_terms[:, i]) for i, name in enumerate(case.ending.reward_terms)]
    rows = [
        [
            name,
            sparkline(values.tolist()),
            *(f"{x:.4g}" for x in (values.sum(), values.min(), values.max(), values[-1])),
        ]
        for name, values in [*series, ("reward", case.reward)]
    ]
    console.table(
        ["REWARD A STEP", f"{case.times[0]:.3g} .. {case.times[-1]:.3g} s", "SUM", "MIN", "MAX", "LAST"], rows
    )


def _tell_steps(case: Case, steps: int) -> None:
    """What the policy saw and did in the last steps, and what that paid; a row each."""
    last = range(max(0, case.steps - steps), case.steps)
    groups = [
        ("saw", case.ending.observations, case.observations),
        ("did", case.ending.actions, case.actions),
        ("paid", case.ending.reward_terms, case.reward_terms),
    ]
    rows = [["", "end of step [s]", *(f"{case.times[i]:.4g}" for i in last)]]
    left = 0
    for word, names, values in groups:
        rows += [[word, name, *(f"{values[i, c]:.4g}" for i in last)] for c, name in enumerate(names[:_MANY])]
        left += len(names[_MANY:])
    rows.append(["paid", "reward", *(f"{case.reward[i]:.4g}" for i in last)])
    console.data("")
    console.table(["", "", *(f"{i - case.steps + 1}" for i in last)], rows)
    if left:
        console.info(f"{left} further columns are in --json")


def _tell_contacts(case: Case, contacts: Sequence[Any]) -> None:
    console.data("")
    if not contacts:
        console.data("contacts at the end: none")
        return
    rows = [[*c.geoms, f"{1e3 * c.distance:.3f}", f"{c.force:.4g}"] for c in contacts[: 2 * _MANY]]
    console.table(["CONTACT AT THE END", "", "DISTANCE [mm]", "FORCE [N]"], rows)
    if len(contacts) > 2 * _MANY:
        console.info(f"{len(contacts) - 2 * _MANY} further contacts are in --json")


def _draw(case: Case, scene: Scene, file: Path) -> int:
    from rlcli.viewer.video import Renderer
    from rlcli.viewer.writer import VideoWriter

    config = scene.staged.resolved.task
    stride = max(1, config.sim.render_interval // config.decimation)
    shown = sorted({len(scene.states) - 1 - i for i in range(0, len(scene.states), stride)})  # the end is among them
    with (
        Renderer(scene.staged.model, config.viewer) as renderer,
        VideoWriter(file, stride * case.ending.step_dt) as writer,
    ):
        for number in shown:
            writer.add(renderer.draw(*scene.show(number)))
    console.info(f"{writer.frames} frames at {writer.fps:g} a second, drawn with {renderer.backend}")
    console.data(str(file))
    return writer.frames


def sparkline(values: Sequence[float], width: int = _WIDTH) -> str:
    """Values as bars of eight heights, neighbours averaged where there are more than columns; `?` is not finite."""
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


def _plain(value: Any) -> Any:
    """As JSON, which has no NaN."""
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_plain(inner) for inner in value]
    return repr(value) if isinstance(value, float) and not math.isfinite(value) else value

"""`rlcli replay`: step a recording or a dump again, and say whether it is the same bit by bit."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from rlcli.cli.console import console
from rlcli.cli.options import CHOOSE, Debug, Json, Quiet, Verbose


def command(
    file: Annotated[
        Path,
        typer.Argument(
            help="A recording, written by eval or play with --record, the dump of a divergence, or a case of autopsy."
        ),
    ],
    episode: Annotated[
        int | None, typer.Option("--episode", min=0, help="Only this episode, counted from 0; else all.")
    ] = None,
    video: Annotated[
        Path | None, typer.Option("--video", help="Draw one episode (--episode, else the first) to FILE.mp4 or .gif.")
    ] = None,
    task: Annotated[
        str | None, typer.Option("--task", help="Where the code of a task that is not installed lies now: its folder.")
    ] = None,
    json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
    debug: Debug = False,
) -> None:
    """Replay a recording or a dump."""
    from rlcli.errors import UsageError

    if video is not None:
        from rlcli.viewer.writer import check_video

        video = Path("replay.mp4") if str(video) == CHOOSE else video
        check_video(video)
    from rlcli.rl.dump import is_dump
    from rlcli.rl.trust import named_task

    named = None if task is None else named_task(task)
    if is_dump(file):
        if episode is not None or video is not None:
            raise UsageError(
                "a dump holds no whole episodes: --episode and --video are of recordings",
                hint="rlcli autopsy RUN N --video FILE.mp4 draws a case of a run",
            )
        _dump(file, named)
        return
    from rlcli.rl.recording import read_recording

    recording = read_recording(file)
    count = len(recording.episodes)
    if episode is not None and episode >= count:
        raise UsageError(f"no episode {episode} in {file}", hint=f"it has {count}, counted from 0")
    if not count:
        raise UsageError(f"{file} has no episodes", hint="record with --record-mode all")
    chosen = list(range(count)) if episode is None else [episode]
    difference, frames = _replay(recording, named, chosen, video)
    steps = sum(recording.episodes[number].length for number in chosen)
    said = {
        "file": str(file),
        "episodes": len(chosen),
        "steps": steps,
        "equal": difference is None,
        "video": str(video) if video is not None else None,
        "frames": frames,
    }
    if difference is None:
        console.data(f"{file}: {len(chosen)} episodes, {steps} steps: equal bit by bit")
        console.document("replay", difference=None, **said)
        return
    console.data(
        f"{file}: episode {difference.episode} differs first at step {difference.step} in {difference.field}:"
        f" recorded {_short(difference.recorded)}, now {_short(difference.replayed)}"
    )
    console.info("the task's model or code, MuJoCo or the machine is not what it was recorded with")
    told = {key: getattr(difference, key) for key in ("episode", "step", "field", "recorded", "replayed")}
    console.document("replay", difference=told, **said)
    raise typer.Exit(9)


def _dump(file: Path, named: Any) -> None:
    """Step a dump again, and show where each of its environments went wrong."""
    import torch

    from rlcli.rl.dump import read_dump, replay_dump

    torch.set_num_threads(1)
    dump = read_dump(file)
    result = replay_dump(dump, named)
    document, difference = dump.document, result.difference
    ending = document.ending
    for life in document.lives:
        where = result.where.get(life.env)
        console.data(f"environment {life.env}: {life.cause}{f' ({life.detail})' if life.detail else ''}")
        if ending is not None and ending.kind != "diverged":
            console.data(f"  the end of its episode {ending.episode}, by {', '.join(ending.causes) or 'nothing named'}")
            continue
        console.data(f"  {where or 'a single world shows nothing: the cause lies outside of what is kept'}")
    said = {
        "file": str(file),
        "calls": result.calls,
        "compared": result.compared,
        "equal": difference is None,
        "same_model": result.same_model,
        "episode": None if ending is None else ending.episode,
        "environments": [
            {
                "env": life.env,
                "cause": life.cause,
                "detail": life.detail,
                "where": None if (where := result.where.get(life.env)) is None else _finite(where.model_dump()),
            }
            for life in document.lives
        ],
    }
    if difference is None:
        console.data(
            f"{file}: {result.calls} engine calls stepped again, {result.compared} states compared: equal bit by bit"
        )
        console.document("replay", kind="dump", difference=None, **said)
        return
    console.data(
        f"{file}: environment {difference.env} differs first after engine call {difference.call} in"
        f" {difference.field}: dumped {_short(difference.recorded)}, now {_short(difference.replayed)}"
    )
    what = "MuJoCo or the machine" if result.same_model else "the task's model"
    console.info(f"{what} is not what it was dumped with (MuJoCo {document.mujoco})")
    told = {
        "env": difference.env,
        "call": difference.call,
        "field": difference.field,
        "recorded": [repr(value) for value in difference.recorded],
        "replayed": [repr(value) for value in difference.replayed],
    }
    console.document("replay", kind="dump", difference=told, **said)
    raise typer.Exit(9)


def _finite(values: dict[str, Any]) -> dict[str, Any]:
    """As JSON, which has no NaN."""
    return {name: repr(v) if isinstance(v, float) and not math.isfinite(v) else v for name, v in values.items()}


def _replay(recording: Any, named: Any, chosen: list[int], video: Path | None) -> tuple[Any, int]:
    import torch

    from rlcli.envs.vec_env import make_env
    from rlcli.rl.recording import replay

    torch.set_num_threads(1)
    env = make_env(recording.resolved(named))
    if video is None:
        return replay(recording, env, chosen), 0
    from rlcli.viewer.video import Renderer
    from rlcli.viewer.writer import VideoWriter

    shown = recording.episodes[chosen[0]]
    stride = max(1, env.config.sim.render_interval // env.config.decimation)
    with Renderer(env.engine.model, env.config.viewer) as renderer, VideoWriter(video, stride * env.step_dt) as writer:

        def draw(step: int) -> None:
            if shown.begin <= step < shown.begin + shown.length and (step - shown.begin) % stride == 0:
                writer.add(renderer.picture(env, shown.env))

        difference = replay(recording, env, chosen, draw)
    return difference, writer.frames


def _short(values: list[float]) -> str:
    text = ", ".join(repr(value) for value in values[:6])
    return f"[{text}{', ...' if len(values) > 6 else ''}]"

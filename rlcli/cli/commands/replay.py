"""`rlcli replay`: simulate a trajectory file again, and report whether it is the same bit by bit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import TaskFolder, video_file

if TYPE_CHECKING:
    from rlcli.replay.resimulate import Replay
    from rlcli.replay.trajectory import Trajectory


def command(
    file: Annotated[
        Path,
        typer.Argument(
            help="A recording, written by eval or play with --record, the dump of a divergence, or a case of autopsy."
        ),
    ],
    episode: Annotated[int | None, typer.Option(min=0, help="Only this episode, counted from 0; else all.")] = None,
    video: Annotated[
        Path | None, typer.Option(help="Draw one episode (--episode, else the first) to FILE.mp4 or .gif.")
    ] = None,
    task: TaskFolder = None,
) -> None:
    """Replay a recording or a dump."""
    video = video_file(video, "replay.mp4")
    import torch

    from rlcli.envs.make import make_env
    from rlcli.replay.resimulate import choose_episodes, replay_calls, replay_episodes
    from rlcli.replay.trajectory import read_trajectory
    from rlcli.runs.trusted_tasks import named_task

    torch.set_num_threads(1)
    named = None if task is None else named_task(task)
    trajectory = read_trajectory(file)
    chosen, frames = choose_episodes(trajectory, episode, filmed=video is not None), 0
    if not chosen:
        _print_calls(trajectory, replay_calls(trajectory, named))
        return
    env = make_env(trajectory.resolved(named))
    if video is None:
        result = replay_episodes(trajectory, env, chosen)
    else:
        from rlcli.viewer.replay_video import film_replay

        result, frames = film_replay(trajectory, env, chosen, chosen[0], video)
    _print_episodes(trajectory, result, len(chosen), video, frames)


def _print_episodes(trajectory: Trajectory, result: Replay, episodes: int, video: Path | None, frames: int) -> None:
    """Print the replay of a recording."""
    content = {"episodes": episodes, "steps": result.steps, "video": video, "frames": frames}
    difference = result.difference
    if difference is None:
        _print_result(trajectory, f"{episodes} episodes, {result.steps} steps: equal bit by bit", None, content)
        return
    text = (
        f"episode {difference.episode} differs first at step {difference.step} in {difference.field}:"
        f" recorded {_shortened(difference.recorded)}, now {_shortened(difference.replayed)}"
    )
    console.info("the task's model or code, MuJoCo or the machine is not what it was recorded with")
    values = {name: getattr(difference, name) for name in ("episode", "step", "field", "recorded", "replayed")}
    _print_result(trajectory, text, values, content)


def _print_calls(trajectory: Trajectory, result: Replay) -> None:
    """Print the replay of a crash dump or failure case."""
    from rlcli.runs.atomic_io import finite_json

    header = trajectory.header
    environments = []
    for world in header.worlds:
        point = result.diverged_at.get(world.env)
        console.data(f"environment {world.env}: {world.ended_by}")
        if header.failure is not None and header.failure.kind != "diverged":
            episode = header.episodes[0]
            console.data(f"  the end of its episode {episode.index}, by {', '.join(episode.causes) or 'nothing named'}")
        else:
            console.data(f"  {point or 'a single world shows nothing: the cause lies outside of what is kept'}")
        where = None if point is None else finite_json(point.model_dump())
        environments.append({"env": world.env, "cause": world.cause, "detail": world.detail, "where": where})
    content = {
        "kind": "dump",
        "calls": result.steps,
        "compared": result.compared,
        "same_model": result.same_model,
        "episode": header.episodes[0].index if header.episodes else None,
        "environments": environments,
    }
    difference = result.difference
    if difference is None:
        counts = f"{result.steps} engine calls stepped again, {result.compared} states compared"
        _print_result(trajectory, f"{counts}: equal bit by bit", None, content)
        return
    text = (
        f"environment {difference.env} differs first after engine call {difference.step} in {difference.field}:"
        f" dumped {_shortened(difference.recorded)}, now {_shortened(difference.replayed)}"
    )
    what = "MuJoCo or the machine" if result.same_model else "the task's model"
    console.info(f"{what} is not what it was dumped with (MuJoCo {header.mujoco})")
    values = {
        "env": difference.env,
        "call": difference.step,
        "field": difference.field,
        "recorded": [repr(value) for value in difference.recorded],
        "replayed": [repr(value) for value in difference.replayed],
    }
    _print_result(trajectory, text, values, content)


def _print_result(
    trajectory: Trajectory, text: str, difference: dict[str, Any] | None, content: dict[str, Any]
) -> None:
    """Print the result and the JSON document; exit with 9 if there is a difference."""
    console.data(f"{trajectory.file}: {text}")
    equal = difference is None
    console.document("replay", file=str(trajectory.file), equal=equal, difference=difference, **content)
    if not equal:
        raise typer.Exit(9)


def _shortened(values: list[float]) -> str:
    """Return the first values as text."""
    text = ", ".join(repr(value) for value in values[:6])
    return f"[{text}{', ...' if len(values) > 6 else ''}]"

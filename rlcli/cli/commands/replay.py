"""Command `rlcli replay`: repetition of recorded simulation steps, with a comparison bit by bit.

The steps are in a recording of episodes, in the dump of a diverged simulation, or in a failure case of a training.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rlcli.cli.ui.console import console
from rlcli.cli.ui.options import TaskFolder, video_file

if TYPE_CHECKING:
    from rlcli.replay.resimulate import Difference, Replay
    from rlcli.replay.trajectory import Trajectory


def command(
    file: Annotated[Path, typer.Argument(metavar="FILE")],
    episode: Annotated[int | None, typer.Option(min=0)] = None,
    video: Annotated[Path | None, typer.Option(metavar="FILE")] = None,
    task: TaskFolder = None,
) -> None:
    """Simulate a recording, crash dump or failure case again. Every state is compared bit by bit.

    Options:
        file: Recording of eval or play (--record), crash dump of a diverged simulation, or failure case of a run.
        episode: For a recording: index of the episode to replay, from 0. [default: all]
        video: For a recording: render one episode (that of --episode, else the first) to FILE.mp4 or FILE.gif.
            Without FILE: replay.mp4. `rlcli autopsy` renders failure cases.

    Examples:
        rlcli replay episodes.safetensors
            Replay all episodes of a recording and compare them.
        rlcli replay episodes.safetensors --episode 3 --video episode.mp4
            Replay one episode and render it.
    """
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
        from rlcli.viewer.record_video import film_replay

        result, frames = film_replay(trajectory, env, chosen, chosen[0], video)
    _print_episodes(trajectory, result, len(chosen), video, frames)


def _print_episodes(trajectory: Trajectory, result: Replay, episodes: int, video: Path | None, frames: int) -> None:
    """Print whether the replayed episodes of a recording (`--record`) equal the recorded ones, bit by bit."""
    difference, values = result.difference, None
    text = f"episodes: {episodes}, steps: {result.steps}; equal bit by bit"
    if difference is not None:
        text = (
            f"episode {difference.episode} differs first at step {difference.step} in {_values(difference, 'recorded')}"
        )
        console.info(
            "since the recording, the task, MuJoCo or the machine has changed: undo the change to repeat the recording"
        )
        values = {name: getattr(difference, name) for name in ("episode", "step", "field", "recorded", "replayed")}
    _print_result(trajectory, text, values, episodes=episodes, steps=result.steps, video=video, frames=frames)


def _print_calls(trajectory: Trajectory, result: Replay) -> None:
    """Print, for each environment of a crash dump or failure case, whether the replay equals the file bit by bit."""
    from rlcli.runs.atomic_io import finite_json

    header = trajectory.header
    environments = []
    for world in header.worlds:
        point = result.diverged_at.get(world.env)
        console.data(f"environment {world.env}: {world.ended_by}")
        if header.failure is not None and header.failure.kind != "diverged":
            episode = header.episodes[0]
            console.data(f"  episode {episode.index} was ended by {', '.join(episode.causes) or 'no named cause'}")
        else:
            console.data(
                f"  {point or 'the replay of this environment does not diverge: the file does not contain the cause'}"
            )
        where = None if point is None else finite_json(point.model_dump())
        environments.append({"env": world.env, "cause": world.cause, "detail": world.detail, "where": where})
    difference, values = result.difference, None
    text = f"{result.steps} engine calls simulated again, {result.compared} states compared: equal bit by bit"
    if difference is not None:
        place = f"environment {difference.env} differs first after engine call {difference.step}"
        text = f"{place} in {_values(difference, 'dumped')}"
        changed = "MuJoCo or the machine" if result.same_model else "the task's model"
        console.info(
            f"{changed} has changed since the file was written with MuJoCo {header.mujoco}; the replay may differ"
        )
        values = {"env": difference.env, "call": difference.step, "field": difference.field}
        for name in ("recorded", "replayed"):
            values[name] = [repr(value) for value in getattr(difference, name)]
    _print_result(
        trajectory,
        text,
        values,
        kind="dump",
        calls=result.steps,
        compared=result.compared,
        same_model=result.same_model,
        episode=header.episodes[0].index if header.episodes else None,
        environments=environments,
    )


def _print_result(trajectory: Trajectory, text: str, difference: dict[str, Any] | None, **content: Any) -> None:
    """Print the result and the JSON document; exit with code 9 if there is a difference."""
    console.data(f"{trajectory.file}: {text}")
    equal = difference is None
    console.document("replay", file=str(trajectory.file), equal=equal, difference=difference, **content)
    if not equal:
        raise typer.Exit(9)


def _values(difference: Difference, word: str) -> str:
    """Return the field that differs, with its values in the file and in the replay.

    Args:
        difference: the first difference between the file and the replay.
        word: name for the values of the file in the text: recorded or dumped.
    """
    sides = []
    for values in (difference.recorded, difference.replayed):
        text = ", ".join(repr(value) for value in values[:6])
        sides.append(f"[{text}{', ...' if len(values) > 6 else ''}]")
    return f"{difference.field}: {word} {sides[0]}, now {sides[1]}"

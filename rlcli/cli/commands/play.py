"""Command `rlcli play`: run a policy and show it in a window, in the browser, in a video, or as printed values.

The command can also repeat one episode of an evaluation, and record episodes to a file.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.ui import options
from rlcli.cli.ui.console import console
from rlcli.errors import UsageError
from rlcli.viewer.protocol import VIEWERS

if TYPE_CHECKING:
    from rlcli.envs.step_result import StepResult
    from rlcli.evaluation.session import Session

_FALLBACK_VIDEO = "play.mp4"
_USUAL_ENVS = 16
"""Largest number of environments for a video or printed values, if neither --num-envs nor `play:` sets a number."""
_MIN_VIDEO_S = 5.0
"""Shortest video [s] that may end with a terminated episode; a shorter one continues with the next episode."""


def command(
    task: options.TaskOfPolicy = None,
    overrides: options.Overrides = None,
    checkpoint: options.CheckpointRef = None,
    policy: options.Policy = "trained",
    video: Annotated[Path | None, typer.Option(metavar="FILE")] = None,
    viewer: Annotated[str | None, options.choice("VIEWER", "auto", *VIEWERS, "none")] = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535)] = None,
    drawn: Annotated[int, typer.Option("--show", min=1)] = 1,
    commands: Annotated[list[str] | None, typer.Option("--command", metavar="NAME=X")] = None,
    seconds: Annotated[float | None, typer.Option(min=0.0)] = None,
    stochastic: options.Stochastic = False,
    env: Annotated[int | None, typer.Option(min=0)] = None,
    episode: Annotated[int | None, typer.Option(min=0)] = None,
    record: options.Record = None,
    record_mode: options.RecordMode = "all",
    num_envs: options.NumEnvs = None,
    seed: options.Seed = 42,
    config: options.ConfigFile = None,
    runs_dir: options.RunsDir = None,
    headless: options.Headless = False,
) -> None:
    """Play a policy in a window or the browser, or write a video.

    Options:
        video: Write one episode to FILE.mp4 or FILE.gif, without a window; without FILE into the run. If the episode
            terminates within 5 s, the next episodes follow.
        viewer: auto, native (a window), web (the browser) or none (printed values). auto is a window if there is a
            display, else the browser if started from a terminal, else none. [default: the settings' viewer, or
            auto]
        port: Port of --viewer web, on this machine only; 0 takes any free port. [default: 8080]
        drawn: Number of environments in the image, side by side at the distance scene.env_spacing.
        commands: Hold commands of the task (goals such as a velocity), as in vx=0.5,wz=0; repeatable. The error for a
            wrong name lists the valid names.
        seconds: Maximum length of the video, or time after which the window or page closes [s]. [default: no limit]
        env: With --episode: index of the environment, from 0, whose episode of an evaluation is repeated.
        episode: With --env: index of the episode in that environment, from 0.

    Examples:
        rlcli play cartpole --viewer web
            Show the policy of the newest run of cartpole in the browser.
        rlcli play --checkpoint latest@best --video best.mp4
            Film one episode of the best checkpoint.
    """
    from rlcli.cli.ui.open_viewer import choose_viewers, read_commands, require_viewer, show
    from rlcli.cli.ui.play_episode import check_choice, play_episode
    from rlcli.evaluation.session import PolicyRequest, open_session

    to_file = video is not None or record is not None
    require_viewer(viewer, port, to_file=to_file)
    held = read_commands(commands or [])
    options.video_file(video, _FALLBACK_VIDEO)
    viewers = choose_viewers(viewer, port, headless=headless or to_file)
    _check_record(record, record_mode, video, held)
    _check_seconds(seconds, viewer, record, env)
    if env is not None or episode is not None:
        check_choice(env, episode, num_envs, record_mode, held)
    words, prints = overrides or [], record is None and viewers[0][0] == "none"
    usual = max(_USUAL_ENVS, drawn) if (video is not None or prints) and env is None else None
    request = PolicyRequest(
        task, words, checkpoint, policy, stochastic, num_envs, seed, config, runs_dir, None, (env or 0) + 1, usual
    )
    session = open_session(request)
    file = _default_video(session) if str(video) == options.CHOOSE else video
    watch = functools.partial(show, session, viewers, port=port, drawn=drawn, longest_s=seconds)
    if env is not None and episode is not None:
        play_episode(session, env, episode, video=file, record=record, watch=watch)
        return
    _prepare(session, drawn, held)
    if file is not None:
        _video(session, file, drawn, math.inf if seconds is None else seconds)
    elif record is not None or not watch():
        _statistics(session, record, record_mode)


def _check_record(record: Path | None, mode: str, video: Path | None, commands: dict[str, float]) -> None:
    from rlcli.evaluation.session import check_record

    if record is not None and video is not None:
        raise UsageError("--record and --video cannot be combined", hint="`rlcli replay FILE --video` renders FILE")
    if record is not None and commands:
        raise UsageError("--record cannot be combined with --command", hint="leave out --record or --command")
    check_record(record, mode)


def _check_seconds(seconds: float | None, viewer: str | None, record: Path | None, env: int | None) -> None:
    if seconds is not None and (viewer == "none" or record is not None or env is not None):
        raise UsageError(
            "--seconds cannot be combined with --viewer none, --record or --env: --seconds ends a video, a window or"
            " a page",
            hint="leave out --seconds",
        )


def _prepare(session: Session, drawn: int, commands: dict[str, float]) -> None:
    """Check that there are enough environments to show, and hold the commands."""
    available = session.env.num_envs
    if drawn > available:
        raise UsageError(f"--show {drawn} is above the number of environments, {available}", hint=f"--num-envs {drawn}")
    if commands:
        from rlcli.viewer.playback import hold_command

        for name, value in commands.items():
            hold_command(session.env, name, value)


def _default_video(session: Session) -> Path:
    """Return the file of `--video` without FILE: `videos/STEP.mp4` in the run, else a file in the current folder."""
    run, checkpoint = session.policy.run, session.policy.checkpoint
    if run is None or checkpoint is None:
        return Path(_FALLBACK_VIDEO)
    from rlcli.runs.run import require_own

    require_own(run, "videos")
    return run.folder / "videos" / f"{checkpoint.name}.mp4"


def _video(session: Session, file: Path, drawn: int, longest_s: float) -> None:
    from rlcli.cli.ui.play_episode import film
    from rlcli.evaluation.evaluate import evaluate

    with film(session, file, drawn=drawn) as filming:

        def end_video(step: StepResult) -> None:
            long_enough = filming.length_s >= _MIN_VIDEO_S
            filming.ended |= bool(step.truncated[0] | (step.terminated[0] & long_enough))
            filming.ended |= filming.length_s >= longest_s

        summary = evaluate(session.env, filming.act, session.env.num_envs, end_video).summary()
    frames, fps, backend = filming.writer.frames, filming.writer.fps, filming.renderer.backend
    which = "environment 0" if drawn == 1 else f"environments 0 to {drawn - 1}"
    console.info(f"{frames} frames of {which} at {fps:g} per second, rendered with {backend}")
    console.data(str(file))
    video = {"video": str(file), "frames": frames, "fps": fps, "gl": backend}
    console.document("play", **session.policy.record(), **video, **summary)


def _statistics(session: Session, record: Path | None, record_mode: str) -> None:
    from rlcli.cli.ui.evaluation_tables import show_summary
    from rlcli.evaluation.session import run_episodes, save_episodes

    count = session.env.num_envs
    console.info(f"{count} episodes, one per environment, as numbers (--num-envs N; --video FILE.mp4 writes a video)")
    summary, recorder = run_episodes(session, session.env.num_envs, records=record is not None)
    show_summary(summary)
    recorded, unsaved = save_episodes(recorder, record, record_mode)
    console.document("play", **session.policy.record(), video=None, recorded=recorded, **summary)
    if unsaved is not None:
        raise unsaved

"""`rlcli play`: watch a policy, in a window, in the browser, as a video, or as numbers."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rlcli.cli.ui import options
from rlcli.cli.ui.completion import words
from rlcli.cli.ui.console import console
from rlcli.errors import UsageError
from rlcli.viewer.protocol import VIEWERS

if TYPE_CHECKING:
    from rlcli.envs.step import StepResult
    from rlcli.evaluation.session import Session

_FALLBACK_VIDEO = "play.mp4"
_SHORTEST_S = 5.0
"""A video that begins with a terminated episode goes on until it is this long [s]."""


def command(
    task: options.TaskOfPolicy = None,
    overrides: options.Overrides = None,
    checkpoint: options.CheckpointRef = None,
    policy: options.Policy = "trained",
    video: Annotated[
        Path | None,
        typer.Option(
            help="Write one episode to FILE.mp4 or FILE.gif, offscreen; without FILE into the run. If it is terminated"
            " within 5 s, the next ones too."
        ),
    ] = None,
    viewer: Annotated[
        str | None,
        typer.Option(
            autocompletion=words("auto", *VIEWERS, "none"),
            help="auto, native (a window), web (the browser) or none (numbers). auto: a window if there is a display,"
            " else the browser if a terminal asks, else numbers.",
        ),
    ] = None,
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Of --viewer web, on this machine alone; 0: any. Else 8080.")
    ] = None,
    drawn: Annotated[
        int, typer.Option("--show", min=1, help="How many environments to draw, side by side on the grid.")
    ] = 1,
    commands: Annotated[
        list[str] | None,
        typer.Option("--command", help="Hold commands of the task: vx=0.5,wz=0. A wrong name lists the right ones."),
    ] = None,
    stochastic: options.Stochastic = False,
    env: Annotated[
        int | None, typer.Option(min=0, help="With --episode: one episode of this environment, as eval lives it.")
    ] = None,
    episode: Annotated[int | None, typer.Option(min=0, help="Which of its episodes, counted from 0.")] = None,
    record: options.Record = None,
    record_mode: options.RecordMode = "all",
    num_envs: options.NumEnvs = None,
    seed: options.Seed = 42,
    config: options.ConfigFile = None,
    runs_dir: options.RunsDir = None,
    headless: options.Headless = False,
) -> None:
    """Play a policy."""
    from rlcli.cli.ui.play_episode import check_choice, play_episode
    from rlcli.cli.ui.viewer_choice import choose_viewers, read_commands, require_viewer, show
    from rlcli.evaluation.session import PolicyRequest, open_session

    to_file = video is not None or record is not None
    require_viewer(viewer, port, drawn=to_file)
    held = read_commands(commands or [])
    options.video_file(video, _FALLBACK_VIDEO)
    viewers = choose_viewers(viewer, port, headless=headless or to_file)
    _check_record(record, record_mode, video, held)
    if env is not None or episode is not None:
        check_choice(env, episode, num_envs, record_mode, held)
    words, min_envs = overrides or [], (env or 0) + 1
    request = PolicyRequest(
        task, words, checkpoint, policy, stochastic, num_envs, options.draw_seed(seed), config, runs_dir, min_envs
    )
    session = open_session(request)
    file = _default_video(session) if str(video) == options.CHOOSE else video

    def watch() -> bool:
        return show(session, viewers, port=port, drawn=drawn)

    if env is not None and episode is not None:
        play_episode(session, env, episode, video=file, record=record, watch=watch)
        return
    _prepare(session, drawn, held)
    if file is not None:
        _video(session, file, drawn)
    elif record is not None or not watch():
        _statistics(session, record, record_mode)


def _check_record(record: Path | None, mode: str, video: Path | None, commands: dict[str, float]) -> None:
    from rlcli.evaluation.session import check_record

    if record is not None and video is not None:
        raise UsageError("--record writes episodes, not pictures", hint="rlcli replay FILE --video draws what it holds")
    if record is not None and commands:
        raise UsageError("--record with --command would write episodes that the task alone does not give again")
    check_record(record, mode)


def _prepare(session: Session, drawn: int, commands: dict[str, float]) -> None:
    """Check that there are environments enough to draw, and hold the commands."""
    available = session.env.num_envs
    if drawn > available:
        raise UsageError(f"--show {drawn}, and there are {available} environments", hint=f"--num-envs {drawn}")
    if commands:
        from rlcli.viewer.playback import hold_command

        for name, value in commands.items():
            hold_command(session.env, name, value)


def _default_video(session: Session) -> Path:
    """`videos/STEP.mp4` in the run; for a policy without a run, a file in the current folder."""
    run, checkpoint = session.policy.run, session.policy.checkpoint
    if run is None or checkpoint is None:
        return Path(_FALLBACK_VIDEO)
    from rlcli.runs.run import require_own

    require_own(run, "videos")
    return run.folder / "videos" / f"{checkpoint.name}.mp4"


def _video(session: Session, file: Path, drawn: int) -> None:
    from rlcli.cli.ui.play_episode import film
    from rlcli.evaluation.evaluate import evaluate

    with film(session, file, drawn=drawn) as filming:

        def note_end(step: StepResult) -> None:
            long_enough = filming.length_s >= _SHORTEST_S
            filming.ended |= bool(step.truncated[0] | (step.terminated[0] & long_enough))

        summary = evaluate(session.env, filming.act, session.env.num_envs, note_end).summary()
    frames, fps, backend = filming.writer.frames, filming.writer.fps, filming.renderer.backend
    which = "environment 0" if drawn == 1 else f"environments 0 to {drawn - 1}"
    console.info(f"{frames} frames of {which} at {fps:g} a second, drawn with {backend}")
    console.data(str(file))
    video = {"video": str(file), "frames": frames, "fps": fps, "gl": backend}
    console.document("play", **session.policy.record(), **video, **summary)


def _statistics(session: Session, record: Path | None, record_mode: str) -> None:
    from rlcli.cli.ui.evaluation_tables import show_summary
    from rlcli.evaluation.session import run_episodes

    console.info("one episode an environment, as numbers (--video FILE.mp4 draws)")
    summary, recorded = run_episodes(session, session.env.num_envs, record, record_mode)
    show_summary(summary)
    console.document("play", **session.policy.record(), video=None, recorded=recorded, **summary)

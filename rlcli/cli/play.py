"""`rlcli play`: watch a policy, in a window, as a video, or as numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from rlcli.cli.console import console
from rlcli.cli.options import (
    CHOOSE,
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

_FALLBACK_VIDEO = Path("play.mp4")


def command(
    task: Annotated[
        str | None, typer.Argument(help="A task: its newest run is played. Not needed with --checkpoint.")
    ] = None,
    overrides: Overrides = None,
    checkpoint: CheckpointRef = None,
    policy: Annotated[str, typer.Option("--policy", help="trained, zero or random.")] = "trained",
    video: Annotated[
        Path | None,
        typer.Option(
            "--video", help="Write one episode to FILE.mp4 or FILE.gif, offscreen; without FILE into the run."
        ),
    ] = None,
    viewer: Annotated[str, typer.Option("--viewer", help="auto, native or none.")] = "auto",
    stochastic: Annotated[bool, typer.Option("--stochastic", help="Sample actions as in training.")] = False,
    env: Annotated[
        int | None,
        typer.Option("--env", min=0, help="With --episode: one episode of this environment, as eval lives it."),
    ] = None,
    episode: Annotated[
        int | None, typer.Option("--episode", min=0, help="Which of its episodes, counted from 0.")
    ] = None,
    record: Record = None,
    record_mode: RecordMode = "all",
    num_envs: NumEnvs = None,
    seed: Seed = 42,
    config: ConfigFile = None,
    runs_dir: RunsDir = None,
    json: Json = False,
    quiet: Quiet = False,
    debug: Debug = False,
    headless: Headless = False,
) -> None:
    """Play a policy."""
    from rlcli.cli.session import check_record, open_session
    from rlcli.errors import UsageError, did_you_mean

    console.quiet = quiet
    if viewer not in ("auto", "native", "none"):
        near = did_you_mean(viewer, ("auto", "native", "none"))
        raise UsageError(f"no viewer '{viewer}'", hint=near or "viewers: auto, native, none")
    if video is not None:
        from rlcli.viewer.writer import check_video

        check_video(_FALLBACK_VIDEO if str(video) == CHOOSE else video)
    window = video is None and record is None and _window(viewer, headless)
    if record is not None and video is not None:
        raise UsageError("--record writes episodes, not pictures", hint="rlcli replay FILE --video draws what it holds")
    check_record(record, record_mode)
    if env is not None or episode is not None:
        from rlcli.cli.one_episode import check_choice

        check_choice(env, episode, num_envs, record_mode)
    seed = draw_seed(seed)
    session = open_session(
        task,
        overrides or [],
        checkpoint=checkpoint,
        policy=policy,
        stochastic=stochastic,
        num_envs=num_envs,
        seed=seed,
        config=config,
        runs_dir=runs_dir,
        at_least=1 if env is None else env + 1,
    )
    if env is not None and episode is not None:
        from rlcli.cli.one_episode import play_episode

        video = _default_video(session) if video is not None and str(video) == CHOOSE else video
        drawn = stochastic or policy == "random"
        play_episode(session, env, episode, seed, drawn_actions=drawn, video=video, record=record, window=window)
        return
    if video is not None:
        _video(session, _default_video(session) if str(video) == CHOOSE else video)
    elif window:
        from rlcli.viewer.native import run

        run(session.env, session.act)
    else:
        _statistics(session, record, record_mode)


def _default_video(session: Any) -> Path:
    """`videos/STEP.mp4` in the run; for a policy without a run, a file in the current folder."""
    if session.run is None or session.checkpoint is None:
        return _FALLBACK_VIDEO
    from rlcli.rl.run import require_own

    require_own(session.run, "videos")
    return session.run.folder / "videos" / f"{session.checkpoint.name}.mp4"


def _window(viewer: str, headless: bool) -> bool:
    from rlcli.errors import MachineError
    from rlcli.viewer.gl import has_display

    if viewer == "native" and not has_display():
        raise MachineError(
            "there is no display for a window",
            hint="--video FILE.mp4 draws offscreen, --viewer none prints statistics",
        )
    return viewer == "native" or (viewer == "auto" and has_display() and not headless)


def _video(session: Any, file: Path) -> None:
    from rlcli.rl.rollout import evaluate
    from rlcli.viewer.video import Renderer
    from rlcli.viewer.writer import VideoWriter

    env = session.env
    stride = max(1, env.config.sim.render_interval // env.config.decimation)
    ended = False
    with Renderer(env.engine.model, env.config.viewer) as renderer, VideoWriter(file, stride * env.step_dt) as writer:

        def act(obs: Any) -> Any:
            # a picture of the states that the policy acts in, the first one too
            if not ended and int(env.episode_length_buf[0]) % stride == 0:
                model, data = env.world(0)
                writer.add(renderer.draw(model, data, env.origins[0].tolist()))
            return session.act(obs)

        def note_end(step: Any) -> None:
            nonlocal ended
            ended = ended or bool(step.terminated[0] | step.truncated[0])

        summary = evaluate(env, act, env.num_envs, note_end).summary()
    frames, fps, backend = writer.frames, writer.fps, renderer.backend
    console.info(f"{frames} frames of environment 0 at {fps:g} a second, drawn with {backend}")
    console.data(str(file))
    console.document("play", video=str(file), frames=frames, fps=fps, gl=backend, **summary)


def _statistics(session: Any, record: Path | None, record_mode: str) -> None:
    from rlcli.cli.eval import _show
    from rlcli.cli.session import run_episodes

    console.info("no window asked for, or no display: one episode an environment, as numbers (--video FILE.mp4 draws)")
    summary, recorded = run_episodes(session, session.env.num_envs, record, record_mode)
    _show(summary)
    console.document("play", video=None, recorded=recorded, **summary)

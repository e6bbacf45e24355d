"""`rlcli play`: watch a policy, in a window, in the browser, as a video, or as numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from rlcli.cli.completion import tasks, words
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
    Verbose,
    draw_seed,
)

_FALLBACK_VIDEO = Path("play.mp4")
_SHORTEST_S = 5.0
"""Of a video that begins with an episode that is terminated."""


def command(
    task: Annotated[
        str | None,
        typer.Argument(
            autocompletion=tasks,
            help="A task: its newest run is played, else the policy it ships. Not needed with --checkpoint.",
        ),
    ] = None,
    overrides: Overrides = None,
    checkpoint: CheckpointRef = None,
    policy: Annotated[
        str,
        typer.Option(
            "--policy", autocompletion=words("trained", "zero", "random", "lqr"), help="trained, zero, random or lqr."
        ),
    ] = "trained",
    video: Annotated[
        Path | None,
        typer.Option(
            "--video",
            help="Write one episode to FILE.mp4 or FILE.gif, offscreen; without FILE into the run. If it is terminated"
            " within 5 s, the next ones too.",
        ),
    ] = None,
    viewer: Annotated[
        str | None,
        typer.Option(
            "--viewer",
            autocompletion=words("auto", "native", "web", "none"),
            help="auto, native (a window), web (the browser) or none (numbers). auto: a window if there is a display,"
            " else the browser if a terminal asks, else numbers.",
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option("--port", min=0, max=65535, help="Of --viewer web, on this machine alone; 0: any. Else 8080."),
    ] = None,
    together: Annotated[
        int, typer.Option("--show", min=1, help="How many environments to draw, side by side on the grid.")
    ] = 1,
    asked: Annotated[
        list[str] | None,
        typer.Option("--command", help="Hold commands of the task: vx=0.5,wz=0. A wrong name lists the right ones."),
    ] = None,
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
    verbose: Verbose = False,
    debug: Debug = False,
    headless: Headless = False,
) -> None:
    """Play a policy."""
    from rlcli.cli.session import check_record, open_session
    from rlcli.cli.viewing import choose_viewers, read_commands, require_viewer, show
    from rlcli.errors import UsageError

    require_viewer(viewer, port, drawn=video is not None or record is not None)
    commands = read_commands(asked or [])
    if video is not None:
        from rlcli.viewer.writer import check_video

        check_video(_FALLBACK_VIDEO if str(video) == CHOOSE else video)
    viewers = choose_viewers(viewer, port, headless=headless or video is not None or record is not None)
    if record is not None and video is not None:
        raise UsageError("--record writes episodes, not pictures", hint="rlcli replay FILE --video draws what it holds")
    if record is not None and commands:
        raise UsageError("--record with --command would write episodes that the task alone does not give again")
    check_record(record, record_mode)
    if env is not None or episode is not None:
        from rlcli.cli.one_episode import check_choice

        check_choice(env, episode, num_envs, record_mode, commands)
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
        at_least=1 if env is None else env + 1,
    )
    if env is not None and episode is not None:
        from rlcli.cli.one_episode import play_episode

        video = _default_video(session) if video is not None and str(video) == CHOOSE else video

        def watch() -> bool:
            return show(session, viewers, port=port, together=together, stochastic=stochastic)

        play_episode(session, env, episode, stochastic=stochastic, video=video, record=record, watch=watch)
        return
    if together > session.env.num_envs:
        raise UsageError(
            f"--show {together}, and there are {session.env.num_envs} environments", hint=f"--num-envs {together}"
        )
    if commands:
        from rlcli.viewer.player import hold_command

        for name, value in commands.items():
            hold_command(session.env, name, value)
    if video is not None:
        _video(session, _default_video(session) if str(video) == CHOOSE else video, together)
    elif record is not None or not show(session, viewers, port=port, together=together, stochastic=stochastic):
        _statistics(session, record, record_mode)


def _default_video(session: Any) -> Path:
    """`videos/STEP.mp4` in the run; for a policy without a run, a file in the current folder."""
    if session.run is None or session.checkpoint is None:
        return _FALLBACK_VIDEO
    from rlcli.rl.run import require_own

    require_own(session.run, "videos")
    return session.run.folder / "videos" / f"{session.checkpoint.name}.mp4"


def _video(session: Any, file: Path, together: int) -> None:
    from rlcli.rl.rollout import evaluate
    from rlcli.viewer.crowd import Crowd
    from rlcli.viewer.video import Renderer
    from rlcli.viewer.writer import VideoWriter

    env = session.env
    stride = max(1, env.config.sim.render_interval // env.config.decimation)
    ended = False
    crowd = Crowd(env, together)
    with (
        Renderer(env.engine.model, env.config.viewer, crowd) as renderer,
        VideoWriter(file, stride * env.step_dt) as writer,
    ):

        def act(obs: Any) -> Any:
            # a picture of the states that the policy acts in, the first one too
            if not ended and int(env.episode_length_buf[0]) % stride == 0:
                writer.add(renderer.picture(env))
            return session.act(obs)

        def note_end(step: Any) -> None:
            nonlocal ended
            shown_s = writer.frames * stride * env.step_dt
            ended = ended or bool(step.truncated[0] | (step.terminated[0] & (shown_s >= _SHORTEST_S)))

        summary = evaluate(env, act, env.num_envs, note_end).summary()
    frames, fps, backend = writer.frames, writer.fps, renderer.backend
    shown = "environment 0" if together == 1 else f"environments 0 to {together - 1}"
    console.info(f"{frames} frames of {shown} at {fps:g} a second, drawn with {backend}")
    console.data(str(file))
    console.document("play", **_origin(session), video=str(file), frames=frames, fps=fps, gl=backend, **summary)


def _statistics(session: Any, record: Path | None, record_mode: str) -> None:
    from rlcli.cli.eval import show_summary
    from rlcli.cli.session import run_episodes

    console.info("one episode an environment, as numbers (--video FILE.mp4 draws)")
    summary, recorded = run_episodes(session, session.env.num_envs, record, record_mode)
    show_summary(summary)
    console.document("play", **_origin(session), video=None, recorded=recorded, **summary)


def _origin(session: Any) -> dict[str, Any]:
    checkpoint = str(session.checkpoint) if session.checkpoint else None
    return {"checkpoint": checkpoint, "chosen": session.chosen, "policy": session.policy}

"""Videos of trajectory files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from rlcli.envs.vec_env import VecEnv
from rlcli.replay.failure_cases import StagedCase
from rlcli.replay.resimulate import Replay, replay_episodes
from rlcli.replay.trajectory import Trajectory
from rlcli.viewer.offscreen import Renderer
from rlcli.viewer.video_writer import VideoWriter


def film_replay(
    recording: Trajectory, env: VecEnv, episodes: Iterable[int], filmed: int, file: Path
) -> tuple[Replay, int]:
    """Replay episodes of a recording and film one of them; return the result and the number of frames."""
    episode = recording.header.episodes[filmed]
    stride = max(1, env.config.sim.render_interval // env.config.decimation)
    with Renderer(env.engine.model, env.config.viewer) as renderer, VideoWriter(file, stride * env.step_dt) as writer:

        def draw(step: int) -> None:
            number = step - episode.begin
            if 0 <= number < episode.length and number % stride == 0:
                writer.add(renderer.image(env, episode.env))

        result = replay_episodes(recording, env, episodes, draw)
    return result, writer.frames


def film_case(case: StagedCase, file: Path) -> tuple[int, float, str]:
    """Film the recorded steps of a failure case; return the frames, frames per second and the OpenGL backend."""
    config = case.staged.resolved.task
    stride = max(1, config.sim.render_interval // config.decimation)
    shown = range((len(case.states) - 1) % stride, len(case.states), stride)  # this start includes the last state
    with Renderer(case.staged.model, config.viewer) as renderer, VideoWriter(file, stride * config.step_dt) as writer:
        for number in shown:
            writer.add(renderer.draw(*case.forward(number)))
    return writer.frames, writer.fps, renderer.backend

"""Functions that write a video of an episode: of a policy, of a recording, or of a failure case of a training."""

import contextlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import mujoco
import torch
from torch import Tensor

from rlcli.config.schema import TaskConfig
from rlcli.envs.vec_env import VecEnv
from rlcli.progress import tracked
from rlcli.replay.failure_cases import StagedCase
from rlcli.replay.resimulate import Replay, replay_episodes
from rlcli.replay.trajectory import Trajectory
from rlcli.rl.action_functions import PATIENCE
from rlcli.viewer.env_grid import EnvGrid
from rlcli.viewer.offscreen import Renderer
from rlcli.viewer.video_writer import VideoWriter


@contextlib.contextmanager
def open_video(
    model: mujoco.MjModel, task: TaskConfig, file: Path, env_grid: EnvGrid | None = None
) -> Iterator[tuple[Renderer, VideoWriter, int]]:
    """Open a video file for a `with` block.

    Args:
        model: model of the environments.
        task: the task's configuration, with camera, image size and `render_interval`.
        file: path of the video, an .mp4 or .gif.
        env_grid: environments to draw together in each image; None: only one environment.

    Returns:
        A renderer of images, the writer to which the images are added, and the number of environment steps between two
        frames.

    Raises:
        UsageError: for a file with another suffix.
        DependencyError: if imageio is not installed.
        MachineError: if this machine cannot render, or the file cannot be written.
    """
    stride = max(1, task.sim.render_interval // task.decimation)
    with Renderer(model, task.viewer, env_grid) as renderer, VideoWriter(file, stride * task.step_dt) as writer:
        yield renderer, writer, stride


def record_episode(
    env: VecEnv, act: Callable[[Tensor], Tensor], file: Path, *, longest_s: float | None = None
) -> tuple[int, float, str]:
    """Film environment 0 from a reset to the end of its episode. Frames show the states in which the policy acts.

    Args:
        env: the environments.
        act: the policy: observations (num_envs, d) -> actions (num_envs, a).
        file: path of the video, an .mp4 or .gif; until the video is complete, the file has another name.
        longest_s: longest simulated time of the video [s]; None: ten times the time limit of the task.

    Returns:
        Number of frames, frames per second, and the OpenGL backend.

    Raises:
        UsageError: for a file with another suffix.
        DependencyError: if imageio is not installed.
        MachineError: if this machine cannot render, or the file cannot be written.
    """
    steps = PATIENCE * env.max_episode_length if longest_s is None else max(1, round(longest_s / env.step_dt))
    with open_video(env.engine.model, env.config, file) as (renderer, writer, stride):
        obs = env.reset(seed=env.seed)["policy"]
        for number in tracked(range(steps), "steps", min(steps, env.max_episode_length)):
            if number % stride == 0:
                writer.add(renderer.image(env))
            with torch.no_grad():
                step = env.step(act(obs))
            obs = step.obs["policy"]
            if bool(step.terminated[0] | step.truncated[0]):
                break
        env.check()
    return writer.frames, writer.fps, renderer.backend


def film_replay(
    recording: Trajectory, env: VecEnv, episodes: Iterable[int], filmed: int, file: Path
) -> tuple[Replay, int]:
    """Replay episodes of a recording, compare them with the recording, and film one of them.

    Args:
        recording: the recording.
        env: environments with the recorded configuration.
        episodes: indices of the episodes to replay.
        filmed: index of the episode to film.
        file: path of the video, an .mp4 or .gif.

    Returns:
        The result of the comparison, and the number of frames.

    Raises:
        UsageError, DependencyError, MachineError: see `open_video`.
    """
    episode = recording.header.episodes[filmed]
    with open_video(env.engine.model, env.config, file) as (renderer, writer, stride):

        def draw(step: int) -> None:
            number = step - episode.begin
            if 0 <= number < episode.length and number % stride == 0:
                writer.add(renderer.image(env, episode.env))

        result = replay_episodes(recording, env, episodes, draw)
    return result, writer.frames


def film_case(case: StagedCase, file: Path) -> tuple[int, float, str]:
    """Film the recorded last steps of a failed episode.

    Args:
        case: the failure case.
        file: path of the video, an .mp4 or .gif.

    Returns:
        Number of frames, frames per second, and the OpenGL backend.

    Raises:
        UsageError, DependencyError, MachineError: see `open_video`.
    """
    count = len(case.states)
    with open_video(case.staged.model, case.staged.resolved.task, file) as (renderer, writer, stride):
        # with this first index, the last state is among the filmed ones
        for number in range((count - 1) % stride, count, stride):
            writer.add(renderer.draw(*case.forward(number)))
    return writer.frames, writer.fps, renderer.backend

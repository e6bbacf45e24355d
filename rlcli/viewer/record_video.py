"""Recording of one episode to a video file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.progress import tracked
from rlcli.rl.acting import PATIENCE
from rlcli.viewer.offscreen import Renderer
from rlcli.viewer.video_writer import VideoWriter


def record_episode(
    env: VecEnv, act: Callable[[Tensor], Tensor], file: Path, *, longest_s: float | None = None
) -> tuple[int, float, str]:
    """Film environment 0 from a reset to the end of its episode. Frames show the states in which the policy acts.

    Args:
        env: the environments.
        act: the policy: observations (num_envs, d) -> actions (num_envs, a).
        file: an .mp4 or .gif. It gets its name when it is complete.
        longest_s: longest simulated time of the video [s]; None: `PATIENCE` episode lengths, as in an evaluation.

    Returns:
        Number of frames, frames per second, and the OpenGL backend.

    Raises:
        UsageError: for a file with another suffix.
        DependencyError: if imageio is not installed.
        MachineError: if this machine cannot render, or the file cannot be written.
    """
    stride = max(1, env.config.sim.render_interval // env.config.decimation)
    steps = PATIENCE * env.max_episode_length if longest_s is None else max(1, round(longest_s / env.step_dt))
    with Renderer(env.engine.model, env.config.viewer) as renderer, VideoWriter(file, stride * env.step_dt) as writer:
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

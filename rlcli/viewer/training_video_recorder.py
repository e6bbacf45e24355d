"""Recorder of videos during a training (`--video-every`): each video is an episode of the current policy.

The episode runs in a separate environment, so that videos have no effect on the training.
"""

import logging
from collections.abc import Callable
from pathlib import Path

from rlcli.envs.observers import StepObserver
from rlcli.envs.vec_env import VecEnv
from rlcli.rl.action_functions import trained_policy
from rlcli.rl.policy import Policy
from rlcli.rl.rng import seed_generators, undisturbed
from rlcli.viewer.record_video import record_episode

_log = logging.getLogger(__name__)


class VideoAborted(Exception):
    """Exception that ends the recording of a video because a signal has requested a stop."""


class TrainingVideos(StepObserver):
    """Recorder of videos of the deterministic policy, without effect on the training.

    Every video begins with the same initial state and seed. The environment is kept between videos; the OpenGL context
    is freed after each video.

    Args:
        make_env: builds a single environment; called before the first video.
        folder: folder of the videos, which are named `STEP.mp4` after the number of environment steps.
        interval: number of iterations between videos.
        stopping: returns whether a signal has requested a stop.
    """

    def __init__(
        self, make_env: Callable[[], VecEnv], folder: Path, interval: int, stopping: Callable[[], bool] = lambda: False
    ) -> None:
        self._make_env, self._folder, self._interval = make_env, folder, interval
        self._stopping = stopping
        self._env: VecEnv | None = None
        self._warned: set[str] = set()

    def due(self, iteration: int) -> bool:
        """Return whether the policy is filmed after an iteration, which is counted from 1."""
        return iteration % self._interval == 0

    def record(self, policy: Callable[[], Policy], step: int) -> Path | None:
        """Film an episode and return the video's file.

        None: the training is stopping, or an error occurred, of which the log warns once for each type of error.

        Args:
            policy: returns a copy of the policy.
            step: number of environment steps of the training so far, for the name of the file.
        """
        file = self._folder / f"{step:012d}.mp4"
        try:
            with undisturbed():
                if self._env is None:
                    seed_generators(0)  # some tasks sample random numbers while they are built
                    self._env = self._make_env()
                    self._env.observers.add(self)
                seed_generators(self._env.seed)
                record_episode(self._env, trained_policy(self._env, policy()), file)
        except VideoAborted:
            return None
        except Exception as error:  # a full disk, a driver, an encoder, or the task's own code must not stop training
            kind = type(error).__name__
            if kind not in self._warned:
                reason = " ".join(str(error).split()) or kind
                _log.warning(f"the video {file.name} was not written: {reason}; training continues")
            self._warned.add(kind)
            return None
        return file

    def before_step(self) -> None:
        """End the recording if the training is being stopped; called before each step of the filmed environment.

        Raises:
            VideoAborted: if a signal has requested a stop.
        """
        if self._stopping():
            raise VideoAborted

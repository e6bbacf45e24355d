"""Recorder of videos during a training (`--video-every`): one episode of the current policy.

The episode runs in a separate environment, so that the training does not change.
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
    """Exception that ends the recording of a video because training is being stopped."""


class TrainingVideos(StepObserver):
    """Recorder of videos of the deterministic policy, always in the same episode. It does not change the training.

    The environment is kept between videos; the OpenGL context is freed after each video.

    Args:
        make_env: builds a single environment, before the first video.
        folder: folder of the videos `STEP.mp4`.
        interval: iterations between videos.
        stopping: returns whether a stop of the training was requested.
    """

    def __init__(
        self, make_env: Callable[[], VecEnv], folder: Path, interval: int, stopping: Callable[[], bool] = lambda: False
    ) -> None:
        self._make_env, self._folder, self._interval = make_env, folder, interval
        self._stopping = stopping
        self._env: VecEnv | None = None
        self._warned: set[str] = set()

    def due(self, iteration: int) -> bool:
        """Return whether the policy is filmed after this iteration."""
        return iteration % self._interval == 0

    def record(self, policy: Callable[[], Policy], step: int) -> Path | None:
        """Film an episode and return the video's file; None if that failed, which is logged, or training is stopping.

        Args:
            policy: returns a copy of the policy, so that filming does not change the trained one.
            step: environment steps so far, which name the file.
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
        """Raise `VideoAborted` if training is being stopped."""
        if self._stopping():
            raise VideoAborted

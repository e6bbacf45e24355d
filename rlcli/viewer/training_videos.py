"""Videos of a training: now and then one episode of the policy as it is, in an environment of its own."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rlcli.envs.observers import StepObserver
from rlcli.rl.acting import trained_policy
from rlcli.rl.rng import seed_generators, undisturbed
from rlcli.viewer.record_video import record_episode

if TYPE_CHECKING:
    from rlcli.envs.vec_env import VecEnv
    from rlcli.rl.policy import Policy

_log = logging.getLogger(__name__)


class VideoAborted(Exception):
    """Somebody asks training to stop, and the clip is not waited for."""


class TrainingVideos(StepObserver):
    """Films the deterministic policy every so many iterations, always in the same episode; training does not notice.

    Between clips there is nothing but the idle environment: the OpenGL context is freed.

    Args:
        make_env: builds an environment of one world, at the first clip.
        folder: where `STEP.mp4` goes.
        interval: iterations between clips.
        stopping: whether somebody asks training to stop.
    """

    def __init__(
        self,
        make_env: Callable[[], VecEnv],
        folder: Path,
        interval: int,
        stopping: Callable[[], bool] = lambda: False,
    ) -> None:
        self._make_env, self._folder, self._interval = make_env, folder, interval
        self._stopping = stopping
        self._env: VecEnv | None = None
        self._warned: set[str] = set()

    def due(self, iteration: int) -> bool:
        """Whether there is a clip of the policy after this iteration."""
        return iteration % self._interval == 0

    def record(self, policy: Callable[[], Policy], step: int) -> Path | None:
        """Write a clip of the policy that is made for it; None if that failed."""
        file = self._folder / f"{step:012d}.mp4"
        try:
            with undisturbed():
                if self._env is None:
                    seed_generators(0)  # whenever it is built, of tasks that draw as they are
                    self._env = self._make_env()
                    self._env.observers.add(self)
                seed_generators(self._env.seed)
                record_episode(self._env, trained_policy(self._env, policy()), file)
        except VideoAborted:
            return None
        except Exception as error:  # a full disk, a driver, an encoder, a task's own code
            kind = type(error).__name__
            if kind not in self._warned:
                _log.warning(f"no clip {file.name}: {' '.join(str(error).split()) or kind}; training goes on")
            self._warned.add(kind)
            return None
        return file

    def close(self) -> None:
        """Let go of the environment."""
        if self._env is not None:
            self._env.close()

    def before_step(self) -> None:
        """Raise `VideoAborted` once training stops."""
        if self._stopping():
            raise VideoAborted

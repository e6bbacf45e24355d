"""The classes of rl_games that the trainers use. The import suppresses rl_games' warnings and output."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Iterator
from typing import Any

from rlcli.rl.trainer_base import require_library

require_library("rl-games", "rl-games>=1.6,<1.7", at_least=(1, 6), below=(1, 7))

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # modules that rl_games imports give warnings
    from rl_games.algos_torch.a2c_continuous import A2CAgent
    from rl_games.algos_torch.sac_agent import SACAgent
    from rl_games.common.algo_observer import AlgoObserver
    from rl_games.common.experience import VectorizedReplayBuffer
    from rl_games.common.gym_compat import gym
    from rl_games.common.ivecenv import IVecEnv
    from rl_games.common.tr_helpers import DefaultRewardsShaper

__all__ = [
    "A2CAgent",
    "AlgoObserver",
    "DefaultRewardsShaper",
    "IVecEnv",
    "NullWriter",
    "SACAgent",
    "VectorizedReplayBuffer",
    "gym",
    "silenced",
]


class NullWriter:
    """Replacement for rl_games' writer of TensorBoard files, since rlcli logs the metrics."""

    def add_scalar(self, *_: Any, **__: Any) -> None:
        """Do nothing."""


@contextlib.contextmanager
def silenced() -> Iterator[None]:
    """Suppress rl_games' prints and warnings: stdout is for data."""
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield

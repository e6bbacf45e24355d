"""Term for the condition of success of `hand-reorient`."""

from __future__ import annotations

from torch import Tensor

from rlcli.envs.direct import DirectEnv


def goals_reached(env: DirectEnv) -> Tensor:
    """Return how many goals the current episode of `hand-reorient` has reached. (num_envs,)"""
    return env.task.successes  # type: ignore[attr-defined]

"""What counts as success. (num_envs,) bool each."""

from __future__ import annotations

from torch import Tensor

from rlcli.envs.direct import DirectEnv


def goals_reached(env: DirectEnv, *, at_least: int) -> Tensor:
    """The running episode of `hand-reorient` has reached so many goals. (num_envs,)"""
    return env.task.successes >= at_least  # type: ignore[attr-defined]

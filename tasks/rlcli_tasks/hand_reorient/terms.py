"""Success terms. (num_envs,) bool each."""

from __future__ import annotations

from torch import Tensor

from rlcli.envs.direct import DirectEnv


def goals_reached(env: DirectEnv, *, at_least: int) -> Tensor:
    """Return where the current episode of `hand-reorient` has reached at least this many goals. (num_envs,)"""
    return env.task.successes >= at_least  # type: ignore[attr-defined]

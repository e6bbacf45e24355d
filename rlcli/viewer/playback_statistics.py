"""Statistics of a playback for the panel of a viewer: rewards of the last seconds, returns, and ends of episodes."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import torch

from rlcli.envs.step_result import StepResult
from rlcli.envs.vec_env import VecEnv
from rlcli.managers.reward import RewardManager

_SHOWN_S = 5.0
"""Time span of the reward curves [s]."""
_MAX_POINTS = 150
"""Largest number of points of a curve; with every image, all points are sent to the browser."""


@dataclass(frozen=True, slots=True)
class RewardCurves:
    """Rewards of the shown environment over the last seconds, for a plot."""

    time_s: tuple[float, ...] = ()
    """Time of each point before the newest one, at most 0 [s]."""
    values: tuple[tuple[str, tuple[float, ...]], ...] = ()
    """(name, points) of the reward, then of each reward term multiplied by its weight."""


class PlaybackStatistics:
    """Rewards of the last seconds in the shown environment, and ends of episodes in all, for the panel of a viewer."""

    def __init__(self, env: VecEnv) -> None:
        self._env = env
        self._terms: RewardManager | None = getattr(env, "reward_manager", None)
        self._every = max(1, round(_SHOWN_S / env.step_dt / _MAX_POINTS))
        self._rows: deque[tuple[float, ...]] = deque(maxlen=round(_SHOWN_S / env.step_dt / self._every))
        self._steps = 0
        self.returns = torch.zeros(env.num_envs)
        """Return of each running episode. (num_envs,)"""
        self.ended = torch.zeros(env.num_envs, dtype=torch.int64)
        """Number of episodes that have ended in each environment. (num_envs,)"""
        self.succeeded = torch.zeros(env.num_envs, dtype=torch.int64)
        """Number of episodes that have ended with success in each environment. (num_envs,)"""
        self._last: dict[int, str] = {}

    def add(self, result: StepResult, shown: int) -> None:
        """Add the result of a step; `shown` is the index of the environment whose rewards are kept for the curves."""
        self._steps += 1
        self.returns += result.reward.cpu()
        if self._steps % self._every == 0:
            terms = [] if self._terms is None else self._terms.step_terms[:, shown].tolist()
            self._rows.append((float(result.reward[shown]), *terms))
        done = (result.terminated | result.truncated).cpu()
        self.ended += done
        self.returns[done] = 0.0
        episodes = result.episodes.ended() if result.episodes is not None else None
        if episodes is None:
            return
        if episodes.success is not None:
            self.succeeded[episodes.ids.cpu()] += episodes.success.cpu()
        for row, env_id in enumerate(episodes.ids.tolist()):
            fired = [name for name, causes in episodes.causes.items() if bool(causes[row])]
            parts = [f"return {float(episodes.returns[row]):.4g}", f"{int(episodes.lengths[row])} steps", *fired]
            self._last[env_id] = ", ".join(parts)

    def last_episode(self, env_id: int) -> str:
        """Return text about an environment's last episode: return, length, causes of its end; empty without one."""
        return self._last.get(env_id, "")

    def clear_curves(self) -> None:
        """Clear the reward curves; called when another environment is shown."""
        self._rows.clear()

    def clear_returns(self) -> None:
        """Clear returns and reward curves; called when every environment starts a new episode."""
        self.returns.zero_()
        self.clear_curves()

    def curves(self) -> RewardCurves:
        """Return the reward and its terms in the shown environment over the last seconds."""
        names = ["reward", *(() if self._terms is None else [term.name for term in self._terms.terms])]
        step_s = self._every * self._env.step_dt
        times = tuple(step_s * (number - len(self._rows) + 1) for number in range(len(self._rows)))
        return RewardCurves(times, tuple(zip(names, zip(*self._rows, strict=True), strict=False)))

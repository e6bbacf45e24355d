"""Statistics of finished episodes, under rsl_rl's metric names, so that its dashboards carry over."""

from __future__ import annotations

from collections import deque
from typing import Any

from rlcli.envs.vec_env import Episodes


class EpisodeStatistics:
    """Gathers the episodes of an iteration; returns and lengths are means over the last 100.

    `Episode_Reward/<term>` is the mean episodic sum over the episode's full length in seconds (Isaac Lab's
    definition); `Episode_Termination/<term>` the share of episodes at whose end the term had fired.
    """

    WINDOW = 100

    def __init__(self, episode_length_s: float) -> None:
        self._episode_length_s = episode_length_s
        self._returns: deque[float] = deque(maxlen=self.WINDOW)
        self._lengths: deque[int] = deque(maxlen=self.WINDOW)
        self._successes: deque[bool] = deque(maxlen=self.WINDOW)
        self._terms: dict[str, float] = {}
        self._causes: dict[str, float] = {}
        self._count = 0
        self.total = 0

    def add(self, episodes: Episodes | None) -> None:
        """Take in the episodes that a step finished."""
        if episodes is None:
            return
        self._returns.extend(episodes.returns.tolist())
        self._lengths.extend(episodes.lengths.tolist())
        if episodes.success is not None:
            self._successes.extend(episodes.success.tolist())
        for name, values in episodes.reward_terms.items():
            self._terms[name] = self._terms.get(name, 0.0) + float(values.sum())
        for name, fired in episodes.causes.items():
            self._causes[name] = self._causes.get(name, 0.0) + float(fired.sum())
        self._count += len(episodes.ids)
        self.total += len(episodes.ids)

    def flush(self) -> dict[str, float]:
        """Metrics of the iteration that ends; a mean over no episode is left out."""
        metrics: dict[str, float] = {}
        if self._returns:
            metrics["Train/mean_reward"] = sum(self._returns) / len(self._returns)
            metrics["Train/mean_episode_length"] = sum(self._lengths) / len(self._lengths)
        if self._successes:
            metrics["Train/success_rate"] = sum(self._successes) / len(self._successes)
        if self._count:
            scale = 1.0 / (self._count * self._episode_length_s)
            metrics |= {f"Episode_Reward/{name}": value * scale for name, value in self._terms.items()}
            metrics |= {f"Episode_Termination/{name}": value / self._count for name, value in self._causes.items()}
        self._terms, self._causes, self._count = {}, {}, 0
        return metrics

    def state(self) -> dict[str, Any]:
        """The windows, as plain JSON."""
        return {
            "returns": list(self._returns),
            "lengths": list(self._lengths),
            "successes": list(self._successes),
            "total": self.total,
        }

    def load(self, state: dict[str, Any]) -> None:
        """Take back what `state` gave."""
        self._returns = deque(state["returns"], maxlen=self.WINDOW)
        self._lengths = deque(state["lengths"], maxlen=self.WINDOW)
        self._successes = deque(state["successes"], maxlen=self.WINDOW)
        self.total = state["total"]

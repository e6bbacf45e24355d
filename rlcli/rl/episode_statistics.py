"""Statistics of the episodes that finish during a training: returns, lengths, terminations, success.

The metrics have the names of RSL-RL, so that dashboards made for RSL-RL can show them.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import torch
from torch import Tensor

from rlcli.envs.step_result import Episodes
from rlcli.rl.distributed import ProcessGroup

_METRICS = {
    "term": "Episode_Reward",
    "cause": "Episode_Termination",
    "metric": "Metrics",
    "held": "Success",
    "value": "Success_Value",
}
"""Prefix of the name of a sum over episodes -> group (first part of the name) of the metric computed from the sum."""


class EpisodeStatistics:
    """Statistics of the finished episodes of an iteration.

    `Train/*` are means over the last iterations that together have at least `WINDOW` episodes. The other metrics are
    of one iteration:

    - `Episode_Reward/<term>`: mean sum of the term over an episode, divided by the full episode length [s] (Isaac
      Lab's definition);
    - `Episode_Termination/<term>`: share of the episodes that the term ended;
    - `Metrics/<command>/<metric>`: mean of a metric that a command term computes, such as its tracking error; in a
      direct task `Metrics/<metric>`;
    - `Success/<condition>`: share of the episodes in whose last `hold_s` seconds the condition of success held;
    - `Success_Value/<condition>`: mean of the condition's value in the last step.

    The sums stay on the environment's device, so that adding to them forces no host sync.
    """

    WINDOW = 100
    """Smallest number of finished episodes over which the metrics `Train/*` are averaged, once so many have ended."""

    def __init__(self, episode_length_s: float) -> None:
        self._episode_length_s = episode_length_s
        self._sums: dict[str, Tensor] = {}
        self._recent: deque[list[float]] = deque()
        self.total = 0

    def add(self, episodes: Episodes | None) -> None:
        """Add the episodes that ended in a step; if `episodes.mask` is not None, only those where the mask is true.

        `episodes` is `StepResult.episodes`; None: no episode ended.
        """
        if episodes is None:
            return
        values = {"return": episodes.returns, **{f"term.{k}": v for k, v in episodes.reward_terms.items()}}
        values |= {f"metric.{k}": v for k, v in episodes.metrics.items()}
        values |= {f"value.{k}": v for k, v in episodes.condition_values.items()}
        flags = {f"cause.{k}": v for k, v in episodes.causes.items()}
        flags |= {f"held.{k}": v for k, v in episodes.conditions.items()}
        if episodes.success is not None:
            flags["success"] = episodes.success
        flags["count"] = torch.ones_like(episodes.truncated) if episodes.mask is None else episodes.mask
        parts = [torch.stack(list(values.values())), torch.stack(list(flags.values())).float()]
        matrix = torch.cat([*parts, episodes.lengths.float()[None]])  # (statistics, episodes)
        weight = torch.ones(matrix.shape[1]) if episodes.mask is None else episodes.mask.float()
        names = ",".join([*values, *flags, "length"])
        if names not in self._sums:
            # outside of inference mode, because `flush` may write to this tensor there
            with torch.inference_mode(False):
                self._sums[names] = torch.zeros(len(matrix), dtype=torch.float32, device=matrix.device)
        self._sums[names].addmv_(matrix, weight)

    def all_reduce(self, process_group: ProcessGroup) -> None:
        """Sum the statistics over all processes; change nothing while a process has not yet finished an episode."""
        own = len(self._sums)
        (total,) = process_group.sum(own)
        if own and total == own * process_group.world_size:
            for values in self._sums.values():
                process_group.average_(values).mul_(process_group.world_size)

    def flush(self) -> dict[str, float]:
        """Return the metrics of the iteration, by name, and begin a new iteration.

        In an iteration without finished episodes, only the metrics `Train/*` are returned.
        """
        sums: dict[str, float] = {}
        for names, values in self._sums.items():
            for name, value in zip(names.split(","), values.tolist(), strict=True):
                sums[name] = sums.get(name, 0.0) + value
            values.zero_()
        count = sums.get("count", 0.0)
        if count:
            self.total += round(count)
            self._recent.append([count, sums["return"], sums["length"], sums.get("success", -1.0)])
            while sum(row[0] for row in self._recent) - self._recent[0][0] >= self.WINDOW:
                self._recent.popleft()
        return {**self._means(), **self._episode_means(sums, count)}

    def state(self) -> dict[str, Any]:
        """Return the sums over the recent iterations as JSON data, for a checkpoint between two iterations."""
        return {"recent": [list(row) for row in self._recent], "total": self.total}

    def load(self, state: dict[str, Any]) -> None:
        """Restore the state returned by `state()`."""
        for pending in self._sums.values():
            pending.zero_()  # in place, because a CUDA graph adds to these tensors
        self._recent = deque(list(row) for row in state["recent"])
        self.total = state["total"]

    def _means(self) -> dict[str, float]:
        if not self._recent:
            return {}
        count, returns, lengths, successes = (sum(column) for column in zip(*self._recent, strict=True))
        means = {"Train/mean_reward": returns / count, "Train/mean_episode_length": lengths / count}
        return means if successes < 0 else {**means, "Train/success_rate": successes / count}

    def _episode_means(self, sums: dict[str, float], count: float) -> dict[str, float]:
        if not count:
            return {}
        scale = 1.0 / (count * self._episode_length_s)
        metrics = {}
        for name, total in sums.items():
            kind, _, term = name.partition(".")
            if kind in _METRICS:
                metrics[f"{_METRICS[kind]}/{term}"] = total * scale if kind == "term" else total / count
        return metrics

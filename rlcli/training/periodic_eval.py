"""Evaluation between iterations, which decides which checkpoint is the best."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rlcli.evaluation.evaluate import evaluate
from rlcli.rl.acting import acting
from rlcli.rl.rng import seed_generators, undisturbed

if TYPE_CHECKING:
    from torch import Tensor

    from rlcli.envs.vec_env import VecEnv
    from rlcli.rl.policy import Policy

_SUCCESS, _RETURN, _LENGTH = "Eval/success_rate", "Eval/mean_reward", "Eval/mean_episode_length"


class PeriodicEval:
    """Evaluation of the deterministic policy every few iterations, always in the same episodes; training is unaffected.

    Args:
        make_env: builds the environment at the first evaluation.
        episodes: episodes of an evaluation.
        interval: iterations between evaluations.
        history: metrics of the iterations so far; those with an evaluation count.
    """

    def __init__(
        self,
        make_env: Callable[[], VecEnv],
        episodes: int,
        interval: int,
        history: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        self._make_env, self._episodes, self._interval = make_env, episodes, interval
        self._env: VecEnv | None = None
        self._fresh: Mapping[str, Tensor] = {}
        best = max(history, key=_score, default={})  # the earliest of equals
        self._best = _score(best)
        self.best: int | None = best["step"] if self._best > _NONE else None
        """Environment steps of the best iteration of the history."""

    def due(self, iteration: int) -> bool:
        """Return whether an evaluation is due after this iteration."""
        return iteration % self._interval == 0

    def run(self, policy: Callable[[], Policy]) -> dict[str, float]:
        """Evaluate a policy; it is made in here, since making one draws random weights."""
        with undisturbed():
            if self._env is None:
                seed_generators(0)  # tasks may draw random numbers while they are built
                self._env = self._make_env()
                self._env.reset(seed=self._env.seed)
                self._fresh = self._env.state_dict()
            self._env.load_state_dict(self._fresh)  # restores curricula too
            seed_generators(self._env.seed)
            summary = evaluate(self._env, acting(self._env, policy()), self._episodes).summary()
        metrics = {_RETURN: summary["return"]["mean"], _LENGTH: summary["length"]["mean"]}
        return {**metrics, _SUCCESS: summary["success"]["rate"]} if "success" in summary else metrics

    def improves(self, metrics: Mapping[str, float]) -> bool:
        """Return whether an evaluation was better than all before it: by success, then by return."""
        better = _score(metrics) > self._best
        self._best = max(self._best, _score(metrics))
        return better

    def close(self) -> None:
        """Close the environment."""
        if self._env is not None:
            self._env.close()


_NONE = (-math.inf, -math.inf)


def _score(metrics: Mapping[str, Any]) -> tuple[float, float]:
    return metrics.get(_SUCCESS, -math.inf), metrics.get(_RETURN, -math.inf)

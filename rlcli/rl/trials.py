"""Evaluation between iterations: which checkpoint is the best."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rlcli.rl.rng import seed_generators, undisturbed
from rlcli.rl.rollout import acting, evaluate

if TYPE_CHECKING:
    from torch import Tensor

    from rlcli.envs.vec_env import VecEnv
    from rlcli.rl.policy import Policy

_SUCCESS, _RETURN, _LENGTH = "Eval/success_rate", "Eval/mean_reward", "Eval/mean_episode_length"


class Trials:
    """Evaluates the deterministic policy every so often, always in the same episodes; training does not notice.

    Args:
        make_env: builds the environment at the first trial.
        episodes: of a trial.
        interval: iterations between trials.
        history: metrics of the iterations so far, of which the trials count.
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
        """Whether the policy is tried after this iteration."""
        return iteration % self._interval == 0

    def run(self, policy: Callable[[], Policy]) -> dict[str, float]:
        """Metrics of a trial of the policy that is made for it: making one draws weights."""
        with undisturbed():
            if self._env is None:
                seed_generators(0)  # whenever it is built, of tasks that draw as they are
                self._env = self._make_env()
                self._env.reset(seed=self._env.seed)
                self._fresh = self._env.state_dict()
            self._env.load_state_dict(self._fresh)  # a curriculum, too, is where it was
            seed_generators(self._env.seed)
            summary = evaluate(self._env, acting(self._env, policy()), self._episodes).summary()
        metrics = {_RETURN: summary["return"]["mean"], _LENGTH: summary["length"]["mean"]}
        return {**metrics, _SUCCESS: summary["success"]["rate"]} if "success" in summary else metrics

    def improves(self, metrics: Mapping[str, float]) -> bool:
        """Whether a trial was better than all before it: in success, then in return."""
        better = _score(metrics) > self._best
        self._best = max(self._best, _score(metrics))
        return better

    def close(self) -> None:
        """Let go of the environment."""
        if self._env is not None:
            self._env.close()


_NONE = (-math.inf, -math.inf)


def _score(metrics: Mapping[str, Any]) -> tuple[float, float]:
    return metrics.get(_SUCCESS, -math.inf), metrics.get(_RETURN, -math.inf)

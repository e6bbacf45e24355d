"""Evaluate the policy every few iterations of a training.

The checkpoint with the best evaluation is RUN@best; a threshold (`--until`) can end the training.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from torch import Tensor

from rlcli.envs.environment_protocol import Environment
from rlcli.evaluation.evaluate import evaluate
from rlcli.rl.action_functions import trained_policy
from rlcli.rl.policy import Policy
from rlcli.rl.rng import seed_generators, undisturbed
from rlcli.training.time_to_threshold import Threshold

_SUCCESS, _RETURN, _LENGTH = "Eval/success_rate", "Eval/mean_reward", "Eval/mean_episode_length"


class PeriodicEval:
    """Evaluation of the deterministic policy every few iterations, always in the same episodes.

    An evaluation leaves the training's random generators and numbers of threads as they were.

    Args:
        make_env: function that builds the environment; it is called at the first evaluation.
        episodes: number of episodes of an evaluation.
        interval: number of iterations between evaluations.
        history: rows of `metrics.jsonl` of the iterations before a resumption; rows without an evaluation are ignored.
        until: threshold at which the training ends; None: only the budget ends the training.
    """

    def __init__(
        self,
        make_env: Callable[[], Environment],
        episodes: int,
        interval: int,
        history: Sequence[Mapping[str, Any]] = (),
        until: Threshold | None = None,
    ) -> None:
        self.until, self.reached = until, False
        self.text = ""
        """Result of the newest evaluation, as text for the user."""
        self._make_env, self._episodes, self._interval = make_env, episodes, interval
        self._env: Environment | None = None
        self._initial_state: Mapping[str, Tensor] = {}
        best = max(history, key=_score, default={})  # if several iterations have the best score, the first one counts
        self._best = _score(best)
        self.best: int | None = best["step"] if self._best > _score({}) else None
        """Environment steps of the best evaluation in the history; None: the history has no evaluation."""

    def due(self, iteration: int) -> bool:
        """Return whether an evaluation is due after an iteration, which is counted from 1."""
        return iteration % self._interval == 0

    def run(self, policy: Callable[[], Policy]) -> dict[str, float]:
        """Evaluate the policy that `policy()` returns; return the metrics `Eval/*`.

        The random generators are saved before `policy()` is called, because that call draws random weights, and are
        restored at the end.
        """
        with undisturbed():
            if self._env is None:
                seed_generators(0)  # a task may draw random numbers while it is built
                self._env = self._make_env()
                self._env.reset(seed=self._env.seed)
                self._initial_state = self._env.state_dict()
            # this also resets curricula, so that each evaluation has the same episodes
            self._env.load_state_dict(self._initial_state)
            seed_generators(self._env.seed)
            summary = evaluate(self._env, trained_policy(self._env, policy()), self._episodes).summary()
        self.text = _text(summary, self.until)
        self.reached = self.until is not None and self.until.is_certain(summary)
        metrics = {_RETURN: summary["return"]["mean"], _LENGTH: summary["length"]["mean"]}
        return {**metrics, _SUCCESS: summary["success"]["rate"]} if "success" in summary else metrics

    def improves(self, metrics: Mapping[str, float]) -> bool:
        """Return whether an evaluation is the best so far, and remember its score.

        Evaluations are compared by their success rate, and if these are equal or missing, by their mean return.
        `metrics` is the result of `run`.
        """
        better = _score(metrics) > self._best
        self._best = max(self._best, _score(metrics))
        return better


def _score(metrics: Mapping[str, Any]) -> tuple[float, float]:
    """Return (success rate, mean return) of an evaluation, to compare evaluations; -inf for a missing metric."""
    return metrics.get(_SUCCESS, -math.inf), metrics.get(_RETURN, -math.inf)


def _text(summary: Mapping[str, Any], until: Threshold | None) -> str:
    """Return the result of an evaluation as text for the user, with the number that `until` compares.

    The text has the metric of `until`, or without a threshold the success rate, or else the mean return.
    """
    key = until.key if until is not None and until.key in summary else "success" if "success" in summary else "return"
    value, low = (summary[key][name] for name in ("rate" if key == "success" else "mean", "low"))
    text = f"{key} {value:.1%}" if key == "success" else f"{key} {value:.4g}"
    text += f" of {summary['episodes']} episodes, without exploration noise"
    if until is None or low is None:
        return text
    return f"{text}; lower end of the 95 % interval {low:.3g}, {until.key}={until.value:g} is needed"

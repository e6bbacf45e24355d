"""Health checks of a training, which read its metrics and report what may prevent learning.

The training loop runs the checks about 40 times in a training; findings are logged and written into run.json.
"""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from rlcli.config.schema import AgentConfig, TaskConfig, bound_text
from rlcli.rl.rng import undisturbed
from rlcli.rl.trainer import Trainer
from rlcli.rl.trainer_base import BaseTrainer

RETURN, LENGTH, SUCCESS = "Train/mean_reward", "Train/mean_episode_length", "Train/success_rate"
_GROUPS = ("Train/", "Eval/success", "Loss/", "Policy/", "Episode_", "Success", "Health/")
"""Prefixes of the names of the metrics that the checks read."""
_TIMES = 40
"""Number of times in a training at which the checks run."""
_MIN_ITERATIONS = 8
"""Number of iterations before the first check."""
_MIN_VALUES = 6
"""Smallest number of values of a metric for checks of its change: the first three and the last three are compared."""
_SOLVED = 0.3
"""Success rate above which only defects are reported, not signs of slow learning."""
_MIN_GAPS, _SURE, _RARE = 4, 5.0, 0.02
"""A lower reward in states of success is reported only after `_MIN_GAPS` comparisons, if the difference is at least
`_SURE` standard errors, and if the success rate has always been below `_RARE`."""
_AT = 1e-3
"""Relative distance from a bound at which a value counts as at the bound."""

Found = Iterator[tuple[str, str]]
"""(message, hint) of each problem that a check finds; the hint is a noun phrase, printed after the word "try"."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Problem that a health check found in a training, and that may prevent learning."""

    check: str
    """Name of the check."""
    iteration: int
    """Iteration in which the check first failed."""
    message: str
    """One sentence with the measured value."""
    hint: str
    """What to try, as a noun phrase."""


class Health:
    """Health checks of one training.

    Args:
        task: the task's configuration.
        agent: the agent's configuration.
        iterations: number of iterations of the whole training.
    """

    def __init__(self, task: TaskConfig, agent: AgentConfig, iterations: int) -> None:
        self.task, self.iterations = task, max(1, iterations)
        self.settings: dict[str, Any] = agent.model_dump()
        self.iteration = 0
        self.findings: list[Finding] = []
        """Problems found both in the last run of the checks and in the run before; others are not reported."""
        self._series: dict[str, list[float]] = {}
        self._suspects: dict[str, Finding] = {}

    @property
    def progress(self) -> float:
        """Share of the training's iterations that are done, from 0 to 1."""
        return self.iteration / self.iterations

    def due(self, iteration: int) -> bool:
        """Return whether the checks run after an iteration, which is counted from 1."""
        every = max(1, self.iterations // _TIMES)
        return iteration >= _MIN_ITERATIONS and (iteration % every == 0 or iteration == self.iterations)

    def add(self, iteration: int, metrics: Mapping[str, Any]) -> None:
        """Add the metrics of an iteration, and run the checks if they are due."""
        self.iteration = iteration
        ended = any(name.startswith("Episode_") for name in metrics)  # without an episode, Train/* repeat old values
        for name, value in metrics.items():
            if name.startswith(_GROUPS) and (ended or not name.startswith("Train/")):
                self._series.setdefault(name, []).append(float(value))
        if not self.due(iteration):
            return
        found: dict[str, Finding] = {}
        for name, check in CHECKS.items():
            for message, hint in check(self):
                begin = self._suspects[name].iteration if name in self._suspects else iteration
                found.setdefault(name, Finding(name, begin, message, hint))
        self.findings = [finding for name, finding in found.items() if name in self._suspects]
        self._suspects = found

    def notes(self, metrics: Mapping[str, float]) -> list[str]:
        """Return a line of text for each success condition in `metrics` (those of the newest iteration)."""
        lines = []
        ends = [
            f"Episode_Termination/{name}" for name, term in self.task.terminations.items() if term and term.time_out
        ]
        complete = sum(metrics.get(name, 0.0) for name in ends)
        few = any(name in metrics for name in ends) and complete < 0.5
        reached = f"; {complete:.1%} of the episodes reached the time-out" if few else ""
        for name, condition in self.task.success.items():
            if condition is not None and f"Success/{name}" in metrics:
                value = metrics.get(f"Success_Value/{name}")
                bound = "" if value is None else f", value {value:.3g}, {bound_text(condition.model_dump())}"
                held = f"{metrics[f'Success/{name}']:.1%}"
                lines.append(f"success in this iteration's episodes: {name} held in {held}{bound}{reached}")
        return lines

    def names(self, prefix: str) -> list[str]:
        """Return the names of the metrics that begin with a prefix, such as `Episode_Reward/`."""
        return [name for name in self._series if name.startswith(prefix)]

    def values(self, name: str) -> list[float]:
        """Return the values of a metric, oldest first."""
        return self._series.get(name, [])

    def first(self, name: str) -> list[float]:
        """Return the oldest eighth of a metric's values, at least three."""
        values = self.values(name)
        return values[: max(3, len(values) // 8)]

    def last(self, name: str) -> list[float]:
        """Return the newest eighth of a metric's values, at least three."""
        values = self.values(name)
        return values[-max(3, len(values) // 8) :]

    def change(self, name: str) -> float:
        """Return a metric's change since the start of the training, in units of the metric's noise.

        The noise is the standard deviation of the values, but at least 10 % of the mean of the first values.
        """
        before, after = self.first(name), self.last(name)
        if not before:
            return 0.0
        size = abs(statistics.fmean(before))
        noise = max(statistics.pstdev(before), statistics.pstdev(after), 0.1 * size, 1e-9)
        return (statistics.fmean(after) - statistics.fmean(before)) / noise

    def is_above_start(self) -> bool:
        """Return whether the newest returns are far above the first return, even if they rose only at the beginning."""
        start, after = self.first(RETURN)[0], self.last(RETURN)
        noise = max(statistics.pstdev(after), 0.1 * abs(start), 1e-9)
        return statistics.fmean(after) - start > 5.0 * noise

    def median(self, name: str) -> float | None:
        """Return the median of a metric's newest values; None without a value."""
        return statistics.median(self.last(name)) if self.values(name) else None

    def struggles(self, after: float) -> bool:
        """Return whether at least the share `after` (0 to 1) of the training is done, and success is still rare.

        In a task without success conditions, success counts as rare.
        """
        return self.progress >= after and all((self.median(n) or 0.0) < _SOLVED for n in (SUCCESS, "Eval/success_rate"))


def probe(trainer: Trainer) -> dict[str, float]:
    """Return the metrics `Health/*`; empty with fewer than 2 observations, or without a `BaseTrainer`."""
    if not isinstance(trainer, BaseTrainer) or len(trainer.recent_obs) < 2:
        return {}
    found, begin, obs = {}, 0, trainer.recent_obs
    constant = (obs == obs[:1]).all(dim=0)
    for term in trainer.env.layout.observations[trainer.spec.group]:
        columns = slice(begin, begin + term.size)
        begin += term.size
        found[f"Health/constant/{term.name}"] = float(constant[columns].all())
        if isinstance(term.clip, tuple) and isinstance(term.clip[0], float):
            scale = torch.tensor(term.scale or (1.0,), device=obs.device)
            edges = torch.tensor(term.clip, device=obs.device)[:, None] * scale
            at_edge = ((obs[:, columns] - edges[:, None]).abs() <= _AT * edges[:, None].abs()).any(dim=0)
            found[f"Health/clipped/{term.name}"] = float((at_edge & ~constant[columns]).float().mean())
    shares = trainer.env.local.condition_shares()
    found |= {f"Health/held/{name}": share for name, share in shares.items()}
    gap = trainer.env.local.success_reward_gap()
    if gap is not None:
        found |= {"Health/reward_gap": gap[0], "Health/reward_gap_in_errors": gap[0] / max(gap[1], 1e-9)}
    with undisturbed():  # a new policy draws random weights
        policy = trainer.policy().to(obs.device)
    if policy.normalizer is not None and policy.normalizer.clip is not None:
        normal = policy.normalizer(obs)
        found["Health/normalized"] = float((normal.abs() >= policy.normalizer.clip * (1 - _AT)).float().mean())
    bound = trainer.spec.action_bound
    if bound is not None:
        with torch.no_grad():
            found["Health/at_bound"] = float((policy(obs).abs() >= bound * (1.0 - _AT)).float().mean())
    return found


def no_reward(health: Health) -> Found:
    """Report a mean return that is the same in all iterations."""
    values = health.values(RETURN)
    if len(values) >= (_MIN_ITERATIONS if any(values) else 3) and max(values) - min(values) <= 1e-6 * abs(values[0]):
        what = "every reward is 0" if values[0] == 0.0 else "the reward depends on nothing that the policy changes"
        message = f"the return is {values[0]:g} in all {len(values)} iterations: {what}"
        yield message, "`rlcli lint TASK`, and other reward weights"


def no_progress(health: Health) -> Found:
    """Report that return, reward terms, episode length and values of success conditions have all stayed the same."""
    # if all episodes end by time-out, few iterations have episodes that end
    if len(health.values(RETURN)) < _MIN_VALUES:
        return
    watched = [RETURN, LENGTH, *health.names("Episode_Reward/"), *health.names("Success_Value/")]
    solved = max(health.values(SUCCESS), default=0.0) >= _SOLVED or health.is_above_start()
    if not solved and health.struggles(0.15) and all(abs(health.change(name)) < 1.0 for name in watched):
        value = statistics.fmean(health.last(RETURN)) if health.values(RETURN) else 0.0
        done = f"the first {health.progress:.0%} of the training"
        message = f"return, reward terms and episode length have not changed in {done} (return {value:.4g})"
        hint = "`rlcli lint TASK` (dead-action, silent-reward, observation-scale), a larger agent.learning_rate"
        yield message, f"{hint}, or larger actions"


def one_termination(health: Health) -> Found:
    """Report a termination that ends nearly all episodes, while episodes do not become longer.

    The length of episodes is compared with that at the start, or in the middle of the training.
    """
    late = {name for name, term in health.task.terminations.items() if term is not None and term.time_out}
    complete = [v for n in late | {"time_out"} for v in _newer_half(health.values(f"Episode_Termination/{n}"))]
    for metric in health.names("Episode_Termination/"):
        name, share = metric.partition("/")[2], health.median(metric)
        if name in late | {"time_out"} or share is None or share < 0.99 or not health.struggles(0.15):
            continue
        early = health.change(LENGTH) < 1.0 and max(complete, default=0.0) < 0.05
        if (early or _stalled(health)) and not _approaches(health.values(RETURN)):
            length = statistics.fmean(health.last(LENGTH))
            since = "at first" if early else "in the middle of the training so far, and none succeeds"
            message = f"{share:.0%} of the episodes end by '{name}' after {length:.0f} steps, no later than {since}"
            yield message, "looser limits, an easier start of episodes, or a reward for each step"


def _stalled(health: Health) -> bool:
    """Return whether no episode has succeeded in half of the training, and episodes do not become longer any more."""
    successes, lengths = health.values(SUCCESS), health.values(LENGTH)
    return bool(successes) and health.struggles(0.5) and not any(successes) and not _approaches(lengths)


def short_episodes(health: Health) -> Found:
    """Report episodes that end after very few steps."""
    length, full = health.median(LENGTH), health.task.max_episode_length
    if length is not None and length <= min(3.0, full / 4):
        yield f"episodes end after {length:.3g} of {full} steps", "`rlcli lint TASK` (early-resets)"


def dying_pays(health: Health) -> Found:
    """Report a return that rises while episodes get shorter."""
    if health.struggles(0.1) and health.change(RETURN) > 1.0 and health.values(LENGTH):
        before, after = (statistics.fmean(part) for part in (health.first(LENGTH), health.last(LENGTH)))
        if after < 0.7 * before:
            message = f"the return rises while episodes shrink from {before:.0f} to {after:.0f} steps"
            yield message, "other signs of the reward weights, a reward for each step, or a penalty for terminations"


def exploration(health: Health) -> Found:
    """Report a standard deviation of actions that has collapsed or exploded."""
    std, begin = health.median("Policy/mean_std"), health.first("Policy/mean_std")
    if std is None or not health.struggles(0.1):
        return
    start, bound = statistics.fmean(begin[:3]), health.settings.get("action_bound")
    fallen = f"the standard deviation of actions has fallen from {start:.3g} to {std:.3g}"
    no_success = health.struggles(0.25) and max(health.values(SUCCESS), default=1.0) < 0.01
    if std < 0.02 * start:
        yield fallen, "a larger entropy_coef"
    elif std < start / 6 and no_success and not _approaches(health.values(RETURN)):
        message = f"{fallen}, the return no longer rises, and no episode succeeds"
        yield message, "an easier start of episodes, wider limits at first, or a larger entropy_coef"
    if std > 3.0 * (bound or float("inf")) or (std > 1.25 * start and std > (bound or 1.0) and _rises(health)):
        limit = f", and the bound of actions is {bound:g}" if bound else ""
        message = f"the standard deviation of actions is {std:.3g}, {std / start:.1f} times the initial one{limit}"
        yield message, "a smaller entropy_coef or init_std, and `rlcli lint TASK` (dead-action)"


def _rises(health: Health) -> bool:
    values = health.values("Policy/mean_std")
    return sum(a < b for a, b in itertools.pairwise(values)) > 0.9 * (len(values) - 1)


def update_size(health: Health) -> Found:
    """Report updates that change the policy too much or hardly at all."""
    kl, target = health.median("Loss/kl"), health.settings.get("desired_kl") or 0.05
    if kl is None or not health.struggles(0.1):
        return
    if kl > 4.0 * target:
        message = f"the KL divergence of an update is {kl:.3g}, more than 4 times {target:g}"
        yield message, "a smaller agent.learning_rate, fewer epochs, or schedule adaptive with desired_kl"
    if abs(kl) < 1e-6:
        yield f"an update hardly changes the policy: its KL divergence is {kl:.1g}", "a larger agent.learning_rate"


def learning_rate_range(health: Health) -> Found:
    """Report an adaptive learning rate that is at its lowest value, or begins outside its range."""
    if not str(health.settings.get("schedule")).startswith("adaptive") or not health.struggles(0.1):
        return
    rate, (floor, top) = health.median("Loss/learning_rate"), health.settings.get("learning_rate_range", (1e-5, 1.0))
    begin = health.settings.get("learning_rate", floor)
    if not 0.99 * floor <= begin <= 1.01 * top:
        message = f"agent.learning_rate is {begin:.3g}, and the schedule adapts it between {floor:g} and {top:g}"
        yield message, "a learning rate within agent.learning_rate_range"
    elif rate is not None and rate <= 1.01 * floor and health.settings["schedule"] == "adaptive":
        message = f"the adaptive learning rate is at its lowest value, {rate:.1g}"
        yield message, "a larger desired_kl, or normalised observations"


def value_function(health: Health) -> Found:
    """Report a critic that does not predict returns."""
    loss, explained = health.median("Loss/value"), health.median("Loss/explained_variance")
    if loss is None or explained is None or not health.struggles(0.15):
        return
    start = statistics.median(health.first("Loss/value"))
    if loss > 1000.0 * max(start, 1e-9) and explained < 0.1:
        message = f"the value loss has grown from {start:.3g} to {loss:.3g}"
        yield message, "a smaller agent.learning_rate or reward_scale"
    elif explained < 0.02 and loss > 0.0 and not _approaches(health.values(RETURN)) and health.change(RETURN) < 1.0:
        message = f"the critic explains {explained:.2f} of the variance of returns"
        yield message, "observations that contain the state, normalize_observations, or another gamma"


def observations(health: Health) -> Found:
    """Report observations that are the same in all environments, or mostly at the limits of their `clip`."""
    for metric in health.names("Health/constant/"):
        if health.median(metric) == 1.0 and health.struggles(0.1):
            name = metric.rpartition("/")[2]
            message = f"the observation '{name}' has the same value in all environments"
            yield message, "another func or scale of this term"
    for metric in [*health.names("Health/clipped/"), *health.names("Health/normalized")]:
        share = health.median(metric) or 0.0
        if share > 0.9 and health.struggles(0.1):
            name = metric.partition("Health/clipped/")[2] or "normalised observations"
            yield (
                f"{share:.0%} of the values of '{name}' are at the limits of the clip",
                "a wider clip, or a smaller scale",
            )


def actions_at_bound(health: Health) -> Found:
    """Report mean actions that are nearly all at their bound."""
    share = health.median("Health/at_bound")
    if share is not None and share > 0.9 and health.struggles(0.15):
        yield f"{share:.0%} of the mean actions are at their bound", "a larger scale of the actions, or a larger bound"


def blocked_success(health: Health) -> Found:
    """Report a success condition that blocks success: it holds much less often than the others, or does not hold."""
    for name, condition in health.task.success.items():
        held, values = health.median(f"Success/{name}"), health.values(f"Success_Value/{name}")
        if held is None or condition is None or not health.struggles(0.15):
            continue
        others = [health.median(n) or 0.0 for n in health.names("Success/") if n != f"Success/{name}"]
        alone = bool(others) and min(others) > 0.5 and held < 0.1 * min(others) and health.progress == 1.0
        learned = health.change(RETURN) > 1.0 and not _approaches(health.values(RETURN))
        shares = health.values(f"Success/{name}")
        # a random policy may have met the condition at the beginning
        never = not any(_newer_half(shares)) and (learned or health.progress == 1.0)
        gaps, states = _gaps(values, condition.model_dump()), health.values(f"Health/held/{name}")
        # the mean is near the bound, but no environment is within it in any of the states at the checks
        halved = _halved(gaps)
        # the condition demands an error of exactly 0
        exact = bool(values) and condition.at_most is not None and condition.at_most <= 0.0 < min(values)
        unmet = not any(shares) and len(states) > 2 and not any(states)
        if (never and not _approaches(gaps)) or alone or (unmet and (halved or exact)):
            value = f"; its value is {statistics.fmean(values[-3:]):.3g}" if values else ""
            bound = f"; it must be {text}" if (text := bound_text(condition.model_dump())) else ""
            message = f"the condition '{name}' of success holds in {held:.1%} of the episodes{value}{bound}"
            yield message, f"a larger reward for this condition, or another bound of success.{name}"


def reward_without_success(health: Health) -> Found:
    """Report a return that has risen while no success condition holds in more states than at the start."""
    shares = []
    for name, condition in health.task.success.items():
        if condition is None:
            continue
        states, gaps = f"Health/held/{name}", _gaps(health.values(f"Success_Value/{name}"), condition.model_dump())
        before, now = (statistics.median(part or [0.0]) for part in (health.first(states), health.last(states)))
        if len(health.values(states)) < 6 or not 0.0 < before < 0.2 or now > 1.2 * before or _halved(gaps):
            return
        shares.append(f"'{name}' in {now:.1%}")
    if shares and health.struggles(0.15) and health.change(RETURN) > 0.7:
        shares_text = ", ".join(shares)
        message = f"the return rises, but conditions of success hold no more often than at the start: {shares_text}"
        yield message, "other signs or weights of the rewards, or a reward for success"


def reward_against_success(health: Health) -> Found:
    """Report rewards that are lower in states of success than in other states."""
    sizes, gaps = health.values("Health/reward_gap_in_errors"), health.values("Health/reward_gap")
    few = len(sizes) < _MIN_GAPS or max(health.values(SUCCESS), default=0.0) >= _RARE
    if few or not health.struggles(0.15) or statistics.median(sizes) > -_SURE or sizes[-1] > -_SURE:
        return
    lower = -statistics.median(gaps)
    message = f"the reward of a step is lower in states of success than in other states, by {lower:.3g}"
    yield message, "other signs or weights of the rewards, or a reward for success"


def falling_success(health: Health) -> Found:
    """Report a success rate that has fallen below half of its best value, both averaged over some iterations."""
    values, size = health.values(SUCCESS), len(health.last(SUCCESS))
    if len(values) < _MIN_VALUES:
        return
    means = [statistics.fmean(values[end - size : end]) for end in range(size, len(values) + 1)]
    if max(means) >= _SOLVED and means[-1] < 0.5 * max(means):
        best, now = max(means), means[-1]
        hint = "a smaller agent.learning_rate or desired_kl, a larger entropy_coef"
        if any(health.task.curriculum.values()):
            hint += ", a slower curriculum"
        yield f"the success rate has fallen from {best:.1%} to {now:.1%}", f"{hint}, or a checkpoint before the fall"


def _gaps(values: list[float], bounds: Mapping[str, Any]) -> list[float]:
    """Return, for each value, the negative distance to the range from `at_least` to `at_most`; 0 within the range."""
    low, high = bounds.get("at_least"), bounds.get("at_most")
    return [-max((low if low is not None else v) - v, v - (high if high is not None else v), 0.0) for v in values]


def _newer_half(values: list[float]) -> list[float]:
    return values[len(values) // 2 :]


def _halved(gaps: list[float]) -> bool:
    return len(gaps) > 3 and statistics.fmean(gaps[-3:]) > 0.5 * statistics.fmean(gaps[:3])


def _approaches(values: list[float]) -> bool:
    """Return whether the newest values exceed those before the middle by over 5 %; True for short lists."""
    part, middle = max(3, len(values) // 8), len(values) // 2
    if len(values) < 4 * part:
        return True
    before, after = values[middle - part : middle], values[-part:]
    rise = statistics.fmean(after) - statistics.fmean(before)
    noise = statistics.median(abs(b - a) for a, b in itertools.pairwise(values))
    return rise > max(0.05 * abs(statistics.fmean(before)), noise)


_IN_ORDER: tuple[Callable[[Health], Found], ...] = (
    *(no_reward, short_episodes, observations, update_size, learning_rate_range, exploration, dying_pays),
    *(one_termination, value_function, actions_at_bound, blocked_success, reward_without_success),
    *(reward_against_success, falling_success, no_progress),
)
CHECKS = {check.__name__.replace("_", "-"): check for check in _IN_ORDER}
"""Name -> check function, in the order in which findings are listed."""

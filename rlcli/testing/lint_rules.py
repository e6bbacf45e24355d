"""The rules of the linter: each looks at recorded rollouts of scripted agents for what gets in the way of learning."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import product
from typing import Any, Literal

import torch
from torch import Tensor

from rlcli.config.schema import AgentConfig
from rlcli.envs.managed import ManagedEnv
from rlcli.envs.vec_env import VecEnv
from rlcli.testing.lint_rollouts import MAX_STEPS, SCRIPTED_AGENTS, RolloutEvidence, record_rollout
from rlcli.testing.task_under_test import error_text, observation_parts
from rlcli.testing.timestep_checks import energy_drift


@dataclass(frozen=True, slots=True)
class Remark:
    """Something in a task that will get in the way of learning."""

    rule: str
    severity: Literal["error", "warning"]
    where: str
    """The term, the column, or the setting."""
    message: str
    hint: str
    numbers: dict[str, float] = field(default_factory=dict)
    """What was measured, by name."""

    def __str__(self) -> str:
        """One line."""
        return f"{self.severity}: {self.rule}: {self.where}: {self.message}; {self.hint}"

    def record(self) -> dict[str, Any]:
        """As plain JSON, which has no infinity."""
        numbers = {name: value if math.isfinite(value) else None for name, value in self.numbers.items()}
        return {**asdict(self), "numbers": numbers}


def error_at(where: str, message: str, hint: str, numbers: dict[str, float]) -> Remark:
    """Return an error of the rule that is running; the linter adds the name of the rule."""
    return Remark("", "error", where, message, hint, numbers)


def warning_at(where: str, message: str, hint: str, numbers: dict[str, float]) -> Remark:
    """Return a warning of the rule that is running, likewise."""
    return Remark("", "warning", where, message, hint, numbers)


def runs_without_error(evidence: RolloutEvidence) -> Iterator[Remark]:
    """The task runs: no agent makes it raise an error."""
    seen = set()
    for rollout in evidence.rollouts:
        if rollout.error is None:
            continue
        text = error_text(rollout.error)
        if text not in seen:
            seen.add(text)
            step = len(rollout.reward)
            message = f"the {rollout.agent} agent was stopped after {step} steps by {text}"
            hint = "mend what raises it; `rlcli check` looks closer"
            yield error_at(evidence.subject.place(rollout.error), message, hint, {"step": step})


AT_ONCE = 5
"""Steps within which an end is one at once."""


def early_resets(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Episodes do not end as soon as they have begun, whatever the agent does."""
    shares = {}
    for rollout in evidence.rollouts:
        begun = [e for e in rollout.episodes if e.ended or e.steps > AT_ONCE]
        early = [e for e in begun if e.steps <= AT_ONCE < rollout.env.max_episode_length]
        shares[rollout.agent] = (len(early) / len(begun) if begun else 0.0, early)
    share, early = min(shares.values(), key=lambda found: found[0])
    if share >= 0.1:
        causes = Counter(cause for episode in early for cause in episode.causes)
        names = ", ".join(name for name, _ in causes.most_common(2)) or "a reset"
        yield error_at(
            f"terminations: {names}",
            f"{share:.0%} of the episodes end within {AT_ONCE} steps, under every agent",
            "start where the termination does not hold (narrower reset ranges), or let it allow more",
            {"share": share, "steps": AT_ONCE},
        )


def _active(evidence: RolloutEvidence) -> list[str]:
    """Reward terms that have a weight."""
    rewards = evidence.subject.resolved.task.rewards
    env = evidence.rollouts[0].env
    if not isinstance(env, ManagedEnv):
        return []
    # a weight that a curriculum moves may well begin at 0, and no dummy agent lives to see it change
    return [name for name, config in rewards.items() if config is not None and config.weight != 0.0]


def silent_rewards(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Every reward term with a weight pays something, at some time, to some agent."""
    if evidence.steps < min(evidence.subject.resolved.task.max_episode_length, MAX_STEPS):
        return  # a look that is shorter than an episode has not seen what comes at its end
    steps = sum(rollout.reward.numel() for rollout in evidence.rollouts)
    for name in _active(evidence):
        values = [rollout.terms[name] for rollout in evidence.rollouts if name in rollout.terms]
        if values and not any(bool(v.any()) for v in values):
            yield warning_at(
                f"rewards.{name}",
                f"is 0 in all {steps} steps of {len(evidence.rollouts)} agents",
                "see that its thresholds, joints and sensors are the meant ones, give it a softer slope, or drop it",
                {"steps": steps},
            )


DOMINANT = 0.99


def dominant_rewards(evidence: RolloutEvidence) -> Iterator[Remark]:
    """No reward term is so large, under every agent, that the others cannot be told."""
    active = _active(evidence)
    shares: dict[str, list[float]] = {name: [] for name in active}
    for rollout in evidence.rollouts:
        sizes = {name: float(rollout.terms[name].double().abs().mean()) for name in active if name in rollout.terms}
        total = sum(sizes.values())
        if total > 0.0 and sum(size > 0.0 for size in sizes.values()) > 1:
            for name, size in sizes.items():
                shares[name].append(size / total)
    for name, found in shares.items():
        if found and min(found) >= DOMINANT:
            others = ", ".join(other for other in active if other != name)
            yield warning_at(
                f"rewards.{name}",
                f"makes {min(found):.1%} or more of the reward's size under every agent: {others} cannot be told",
                "lower its weight, or raise those of the others, until each can be told",
                {"share": min(found)},
            )


def constant_reward(evidence: RolloutEvidence) -> Iterator[Remark]:
    """The reward depends on what the agent does."""
    rewards = torch.cat([rollout.reward.flatten() for rollout in evidence.rollouts])
    if any(bool(rollout.terminated.any()) for rollout in evidence.rollouts) or not rewards.numel():
        return  # living on is then what is paid for
    if bool((rewards == rewards[0]).all()):
        value = float(rewards[0])
        yield error_at(
            "rewards" if isinstance(evidence.rollouts[0].env, ManagedEnv) else "rew_buf",
            f"is {value:g} in every step of every agent, and no episode is terminated: there is nothing to learn",
            "let it depend on the state or the action",
            {"value": value},
        )


def dying_pays(evidence: RolloutEvidence) -> Iterator[Remark]:
    """To end an episode early does not pay more than to live on well."""
    alive, final = [], []
    for rollout in evidence.rollouts:
        ended = rollout.terminated.bool()
        alive.append(rollout.reward[~ended & ~rollout.over.bool()])
        final.append(rollout.reward[ended])
    living, dying = torch.cat(alive), torch.cat(final)
    if len(dying) < 10 or not len(living):
        return
    task = evidence.subject.resolved.task
    gamma = discount_of(evidence.subject.resolved.agent)
    gamma = 0.99 if gamma is None else gamma
    horizon = min(1.0 / max(1.0 - gamma, 1e-6), float(task.max_episode_length))
    rate = _quantile(living, 0.9)  # a good step: what a policy can hope for that does better than these agents
    last = float(dying.median())
    if rate * horizon >= last:
        return
    finished = [e for rollout in evidence.rollouts for e in rollout.episodes if e.ended]
    survived = [e.total for e in finished if not e.terminated]
    terminated = [e.total for e in finished if e.terminated]
    numbers = {"good_step": rate, "last_step": last, "horizon": horizon, "return_terminated": _mean(terminated)}
    message = (
        f"a good step pays {rate:.3g}, {rate * horizon:.3g} over the {horizon:.0f} steps that an agent sees ahead,"
    )
    message += f" and a terminal step {last:.3g}"
    if survived:
        if _mean(terminated) <= _mean(survived):
            return
        numbers["return_survived"] = _mean(survived)
        message += (
            f"; episodes that were terminated return {_mean(terminated):.3g}, those that lived on {_mean(survived):.3g}"
        )
    if rate > 0.0:
        hint = "pay less for the end; if it is the goal, this is as it should be (--ignore dying-pays)"
        yield warning_at("rewards", message, hint, numbers)
        return
    hint = "pay for being alive (is_alive), make terms positive, or let a termination cost more (is_terminated)"
    yield error_at("rewards", message, hint, numbers)


LARGE, SMALL = 100.0, 0.01
"""`cart-double-pendulum` learns as it is from a column that is larger than 75 in 1 % of the steps."""


def constant_observations(evidence: RolloutEvidence) -> Iterator[Remark]:
    """No observation column keeps one value, whatever the agent does; of a picture, some pixel does not."""
    for where, values in _columns(evidence):
        if bool((values == values[:, :1]).all()):
            low = float(values.min())
            what = f"is {low:g}" if len(values) == 1 else "is the same"
            message = f"{what} in every step of every agent"
            hint = "leave it out, or compute it from what changes"
            yield error_at(where, message, hint, {"value": low})


def observation_scale(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Observations are not far from 1 in size, unless the agent normalises them."""
    if getattr(evidence.subject.resolved.agent, "normalize_observations", False):
        return
    for where, values in _columns(evidence):
        sizes = values.abs()
        usual, largest = _quantile(sizes, 0.99), float(sizes.max())
        if bool((values == values[:, :1]).all()) or (largest >= SMALL and usual <= LARGE):
            continue
        message = f"is never larger than {largest:.3g}; below {SMALL:g} it drowns among the others"
        if usual > LARGE:
            message = f"is larger than {usual:.3g} in 1 % of the steps; sizes up to {LARGE:g} are learnt well"
        factor = 10.0 ** round(math.log10(1.0 / (usual if usual > LARGE else largest)))
        hint = f"scale: {factor:g}, or let the agent normalise (normalize_observations: true)"
        yield warning_at(where, message, hint, {"usual": usual, "largest": largest})


def _columns(evidence: RolloutEvidence) -> Iterator[tuple[str, Tensor]]:
    """Each observation column, or picture, and its values in all lives. (columns, steps)"""
    env = evidence.rollouts[0].env
    for group in env.layout.observations:
        rollouts = [rollout.obs[group] for rollout in evidence.rollouts if group in rollout.obs]
        seen = torch.cat([obs.flatten(0, 1) for obs in rollouts]).t()
        for where, columns in observation_parts(env, group):
            yield where, seen[columns].contiguous()


SATURATED = 0.8


def saturated_actions(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Random actions within the bound mostly stay within what actuators can take."""
    (rollout,) = [rollout for rollout in evidence.rollouts if rollout.agent == "random"]
    for name, share in rollout.limited.items():
        if share >= SATURATED:
            yield warning_at(
                name,
                f"is at its limit in {share:.0%} of the steps under random actions within +-{evidence.subject.bound:g}",
                "lower the action's scale (or the gain), or raise the limit: beyond it, actions differ in nothing",
                {"share": share},
            )


DEAD = 1e-6


def dead_actions(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Every column of the action moves something."""
    env = evidence.env(8)
    env.reset(seed=0)
    start = env.state_dict()
    steps = max(5, math.ceil(0.1 / env.step_dt))
    bound = evidence.subject.bound
    # a column may multiply others, so that it moves nothing while they are 0
    others = [torch.full((8, env.layout.action_size), level * bound) for level in (0.0, 0.5)]
    without = [(action, _state_after(env, start, action, steps)) for action in others]
    names = [n for t in env.layout.actions for n in (t.elements if len(t.elements) == t.size else [t.name] * t.size)]
    for column, name in enumerate(names):
        moved = 0.0
        for (base, rest), sign in product(without, (1.0, -1.0)):
            action = base.clone()
            action[:, column] = sign * bound
            moved = max(moved, float((_state_after(env, start, action, steps) - rest).abs().max()))
            if moved > DEAD:
                break
        if moved <= DEAD:
            yield error_at(
                f"actions, column {column} ({name})",
                f"moves nothing: after {steps} steps at +-{bound:g} the state differs by {moved:.1g}"
                " from that without action",
                "see that it drives the meant actuator, with a scale, a gear and a limit that are not 0",
                {"moved": moved, "steps": steps},
            )


def _state_after(env: VecEnv, start: dict[str, Tensor], action: Tensor, steps: int) -> Tensor:
    """Positions and velocities after some steps of one action. (num_envs, nq + nv)"""
    env.load_state_dict(start)
    for _ in range(steps):
        env.step(action.clone())
    return torch.cat([env.engine.field("qpos"), env.engine.field("qvel")], dim=1).double()


DRIFT, RATIO = 0.2, 1.5


def timestep(evidence: RolloutEvidence) -> Iterator[Remark]:
    """The physics time step is short enough: half of it shows the same energy and speeds, twice of it is stable."""
    dt = evidence.subject.resolved.task.sim.dt
    where = f"sim.dt = {dt:g} s"
    hint = "take a smaller sim.dt (and more decimation), more damping or armature, or lower gains and stiffnesses"
    diverged = {rollout.agent: rollout.diverged for rollout in evidence.rollouts if rollout.diverged}
    if diverged:
        agents = ", ".join(diverged)
        message = f"the simulation diverged {sum(diverged.values())} times (agents: {agents})"
        yield error_at(where, message, hint, {"diverged": sum(diverged.values())})
        return
    env = evidence.env(8)
    env.reset(seed=0)
    for step in range(5):
        env.step(SCRIPTED_AGENTS["random"](env, evidence.subject.bound)(step))
    drift = energy_drift(env)
    if drift.relative > DRIFT:
        message = (
            f"left to itself for {drift.seconds:.2g} s, the model's energy differs by {drift.relative:.0%} of what"
        )
        message += f" moves to and fro from that with steps of {dt / 2:g} s; up to {DRIFT:.0%} is usual"
        yield warning_at(where, message, hint, {"energy_drift": drift.relative})
        return
    yield from _compare_half_and_double_step(evidence, dt, where, hint)


def _compare_half_and_double_step(evidence: RolloutEvidence, dt: float, where: str, hint: str) -> Iterator[Remark]:
    task = evidence.subject.resolved.task
    steps = max(10, min(evidence.steps, math.ceil(1.0 / task.step_dt)))
    bound = evidence.subject.bound
    as_is = record_rollout(evidence.env(16), "random", bound, steps)
    half = record_rollout(evidence.env(16, sim__dt=dt / 2, decimation=2 * task.decimation), "random", bound, steps)
    if as_is.error is None and half.error is None:
        a, b = as_is.speed, half.speed
        of_note = torch.maximum(a, b) > 0.05 * torch.maximum(a, b).max()
        ratio = torch.where(of_note & (torch.minimum(a, b) > 0.0), torch.maximum(a / b, b / a), 1.0)
        worst = int(ratio.argmax()) if len(ratio) else 0
        if len(ratio) and float(ratio[worst]) > RATIO:
            model = as_is.env.engine.model
            name = f"joint '{model.joint(int(model.dof_jntid[worst])).name}'"
            message = f"under random actions {name} moves at {float(a[worst]):.3g} (root mean square), and at"
            message += f" {float(b[worst]):.3g} with steps of {dt / 2:g} s; a factor of up to {RATIO:g} is usual"
            yield warning_at(where, message, hint, {"ratio": float(ratio[worst])})
            return
    if 2 * dt > 0.1:
        return
    parts = task.decimation // 2 if task.decimation % 2 == 0 else task.decimation
    twice = record_rollout(evidence.env(16, sim__dt=2 * dt, decimation=parts), "random", bound, steps)
    if twice.diverged:
        message = (
            f"at twice the step the simulation diverges, {twice.diverged} times in {steps} steps: there is no room"
        )
        yield warning_at(where, message, hint, {"diverged_at_twice": twice.diverged})


NEAREST, FARTHEST = 0.05, 10.0


def horizon(evidence: RolloutEvidence) -> Iterator[Remark]:
    """What an agent looks ahead, 1 / (1 - gamma) steps, is of the length of an episode."""
    for name, resolved in evidence.subject.agents().items():
        gamma = discount_of(resolved.agent)
        if gamma is None:
            continue
        steps = resolved.task.max_episode_length
        ahead = math.inf if gamma >= 1.0 else 1.0 / (1.0 - gamma)
        if NEAREST <= round(ahead / steps, 9) <= FARTHEST:  # 1 / (1 - 0.99) is a little less than 100
            continue
        fitting = 1.0 - 1.0 / max(2.0, 0.25 * steps)
        yield warning_at(
            f"agents.{name}.gamma = {gamma:g}",
            f"looks {ahead:.3g} steps ({ahead * resolved.task.step_dt:.2g} s) ahead, and an episode has {steps}"
            f" ({resolved.task.episode_length_s:g} s)",
            f"about {fitting:.3g} looks over a quarter of the episode",
            {"gamma": gamma, "horizon": ahead, "episode": steps},
        )


def discount_of(agent: AgentConfig | None) -> float | None:
    """The discount factor of an agent, wherever its trainer keeps it; None if it has none."""
    return None if agent is None else _find_gamma(agent.model_dump())


def _find_gamma(data: object) -> float | None:
    if not isinstance(data, dict):
        return None
    for key in ("gamma", "discount", "discount_factor"):
        if isinstance(data.get(key), int | float):
            return float(data[key])
    return next((found for value in data.values() if (found := _find_gamma(value)) is not None), None)


RULES: dict[str, Callable[[RolloutEvidence], Iterable[Remark]]] = {
    "stops": runs_without_error,
    "early-resets": early_resets,
    "silent-reward": silent_rewards,
    "dominant-reward": dominant_rewards,
    "constant-reward": constant_reward,
    "dying-pays": dying_pays,
    "constant-observation": constant_observations,
    "observation-scale": observation_scale,
    "saturated-actions": saturated_actions,
    "dead-action": dead_actions,
    "timestep": timestep,
    "horizon": horizon,
}
"""Name -> rule, in the order in which they run. The first line of a rule's docstring says what it wants."""


def _quantile(values: Tensor, share: float) -> float:
    """A quantile, of at most 100,000 of the values, evenly picked."""
    picked = values.flatten()[:: max(1, values.numel() // 100_000)]
    return float(picked.double().quantile(share))


def _mean(values: Sequence[float]) -> float:
    return sum(values) / max(1, len(values))

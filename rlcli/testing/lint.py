"""The linter: whether a task, that may keep its contract to the letter, is one that a policy can learn well.

```python
from rlcli.testing import lint_task

for finding in lint_task("acrobot"):
    print(finding)
```
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from rlcli.config.schema import AgentConfig
from rlcli.envs.managed import ManagedEnv
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import ConfigError, MachineError, RlcliError, UsageError, did_you_mean
from rlcli.registry import find_task
from rlcli.testing.dummies import DUMMIES, Life, live
from rlcli.testing.subject import Subject, observed
from rlcli.testing.timestep import energy_drift

NUM_ENVS = 16
MAX_STEPS = 1000
"""Steps of a dummy agent, where an episode has as many and no other time is given."""


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


class Evidence:
    """What the rules judge: lives under dummy agents, each lived when it is first asked for."""

    def __init__(self, subject: Subject, seconds: float | None) -> None:
        self.subject = subject
        task = subject.resolved.task
        wanted = min(task.max_episode_length, MAX_STEPS) if seconds is None else seconds / task.step_dt
        self.steps = max(1, math.ceil(wanted - 1e-6))
        self._lives: list[Life] | None = None

    @property
    def lives(self) -> list[Life]:
        """One an agent."""
        if self._lives is None:
            self._lives = [live(self.env(), name, self.subject.bound, self.steps) for name in DUMMIES]
        return self._lives

    @property
    def stopped(self) -> bool:
        """Whether a life is known to have ended in an error."""
        return any(life.error is not None for life in self._lives or ())

    @property
    def discount(self) -> float:
        """Of the chosen agent, else 0.99."""
        found = discount_of(self.subject.resolved.agent)
        return 0.99 if found is None else found

    def env(self, num_envs: int = NUM_ENVS, **settings: Any) -> VecEnv:
        """A new environment, with further settings."""
        flags = {key.replace("__", "."): value for key, value in settings.items()}
        # all cores: what a world does is the same at any number of threads
        return self.subject.env(flags={"scene.num_envs": num_envs, "sim.engine_threads": None, **flags})


# --- the rules ---


def stops(evidence: Evidence) -> Iterator[Remark]:
    """The task runs: no agent makes it raise an error."""
    seen = set()
    for life in evidence.lives:
        if life.error is None:
            continue
        error = life.error
        said = error.message if isinstance(error, RlcliError) else f"{type(error).__name__}: {error}"
        if said not in seen:
            seen.add(said)
            message = f"the {life.agent} agent was stopped after {len(life.reward)} steps by {' '.join(said.split())}"
            hint = "mend what raises it; `rlcli check` looks closer"
            yield Remark("stops", "error", evidence.subject.place(error), message, hint, {"step": len(life.reward)})


AT_ONCE = 5
"""Steps within which an end is one at once."""


def early_resets(evidence: Evidence) -> Iterator[Remark]:
    """Episodes do not end as soon as they have begun, whatever the agent does."""
    shares = {}
    for life in evidence.lives:
        begun = [e for e in life.episodes if e.ended or e.steps > AT_ONCE]
        early = [e for e in begun if e.steps <= AT_ONCE < life.env.max_episode_length]
        shares[life.agent] = (len(early) / len(begun) if begun else 0.0, early)
    share, early = min(shares.values(), key=lambda found: found[0])
    if share >= 0.1:
        causes = Counter(cause for episode in early for cause in episode.causes)
        names = ", ".join(name for name, _ in causes.most_common(2)) or "a reset"
        yield Remark(
            "early-resets",
            "error",
            f"terminations: {names}",
            f"{share:.0%} of the episodes end within {AT_ONCE} steps, under every agent",
            "start where the termination does not hold (narrower reset ranges), or let it allow more",
            {"share": share, "steps": AT_ONCE},
        )


def _active(evidence: Evidence) -> list[str]:
    """Reward terms that have a weight."""
    rewards = evidence.subject.resolved.task.rewards
    env = evidence.lives[0].env
    if not isinstance(env, ManagedEnv):
        return []
    # a weight that a curriculum moves may well begin at 0, and no dummy agent lives to see it change
    return [name for name, config in rewards.items() if config is not None and config.weight != 0.0]


def silent_rewards(evidence: Evidence) -> Iterator[Remark]:
    """Every reward term with a weight pays something, at some time, to some agent."""
    if evidence.steps < min(evidence.subject.resolved.task.max_episode_length, MAX_STEPS):
        return  # a look that is shorter than an episode has not seen what comes at its end
    steps = sum(life.reward.numel() for life in evidence.lives)
    for name in _active(evidence):
        values = [life.terms[name] for life in evidence.lives if name in life.terms]
        if values and not any(bool(v.any()) for v in values):
            yield Remark(
                "silent-reward",
                "warning",
                f"rewards.{name}",
                f"is 0 in all {steps} steps of {len(evidence.lives)} agents",
                "see that its thresholds, joints and sensors are the meant ones, give it a softer slope, or drop it",
                {"steps": steps},
            )


DOMINANT = 0.99


def dominant_rewards(evidence: Evidence) -> Iterator[Remark]:
    """No reward term is so large, under every agent, that the others cannot be told."""
    active = _active(evidence)
    shares: dict[str, list[float]] = {name: [] for name in active}
    for life in evidence.lives:
        sizes = {name: float(life.terms[name].double().abs().mean()) for name in active if name in life.terms}
        total = sum(sizes.values())
        if total > 0.0 and sum(size > 0.0 for size in sizes.values()) > 1:
            for name, size in sizes.items():
                shares[name].append(size / total)
    for name, found in shares.items():
        if found and min(found) >= DOMINANT:
            others = ", ".join(other for other in active if other != name)
            yield Remark(
                "dominant-reward",
                "warning",
                f"rewards.{name}",
                f"makes {min(found):.1%} or more of the reward's size under every agent: {others} cannot be told",
                "lower its weight, or raise those of the others, until each can be told",
                {"share": min(found)},
            )


def constant_reward(evidence: Evidence) -> Iterator[Remark]:
    """The reward depends on what the agent does."""
    rewards = torch.cat([life.reward.flatten() for life in evidence.lives])
    if any(bool(life.terminated.any()) for life in evidence.lives) or not rewards.numel():
        return  # living on is then what is paid for
    if bool((rewards == rewards[0]).all()):
        value = float(rewards[0])
        yield Remark(
            "constant-reward",
            "error",
            "rewards" if isinstance(evidence.lives[0].env, ManagedEnv) else "rew_buf",
            f"is {value:g} in every step of every agent, and no episode is terminated: there is nothing to learn",
            "let it depend on the state or the action",
            {"value": value},
        )


def dying_pays(evidence: Evidence) -> Iterator[Remark]:
    """To end an episode early does not pay more than to live on well."""
    alive, final = [], []
    for life in evidence.lives:
        ended = life.terminated.bool()
        alive.append(life.reward[~ended & ~life.over.bool()])
        final.append(life.reward[ended])
    living, dying = torch.cat(alive), torch.cat(final)
    if len(dying) < 10 or not len(living):
        return
    task = evidence.subject.resolved.task
    horizon = min(1.0 / max(1.0 - evidence.discount, 1e-6), float(task.max_episode_length))
    rate = _quantile(living, 0.9)  # a good step: what a policy can hope for that does better than these agents
    last = float(dying.median())
    if rate * horizon >= last:
        return
    finished = [e for life in evidence.lives for e in life.episodes if e.ended]
    lived = [e.total for e in finished if not e.terminated]
    died = [e.total for e in finished if e.terminated]
    numbers = {"good_step": rate, "last_step": last, "horizon": horizon, "return_terminated": _mean(died)}
    message = (
        f"a good step pays {rate:.3g}, {rate * horizon:.3g} over the {horizon:.0f} steps that an agent sees ahead,"
    )
    message += f" and a terminal step {last:.3g}"
    if lived:
        if _mean(died) <= _mean(lived):
            return
        numbers["return_survived"] = _mean(lived)
        message += f"; episodes that were terminated return {_mean(died):.3g}, those that lived on {_mean(lived):.3g}"
    if rate > 0.0:
        hint = "pay less for the end; if it is the goal, this is as it should be (--ignore dying-pays)"
        yield Remark("dying-pays", "warning", "rewards", message, hint, numbers)
        return
    hint = "pay for being alive (is_alive), make terms positive, or let a termination cost more (is_terminated)"
    yield Remark("dying-pays", "error", "rewards", message, hint, numbers)


LARGE, SMALL = 100.0, 0.01
"""`cart-double-pendulum` learns as it is from a column that is larger than 75 in 1 % of the steps."""


def constant_observations(evidence: Evidence) -> Iterator[Remark]:
    """No observation column keeps one value, whatever the agent does; of a picture, some pixel does not."""
    for where, values in _columns(evidence):
        if bool((values == values[:, :1]).all()):
            low = float(values.min())
            what = f"is {low:g}" if len(values) == 1 else "is the same"
            message = f"{what} in every step of every agent"
            hint = "leave it out, or compute it from what changes"
            yield Remark("constant-observation", "error", where, message, hint, {"value": low})


def observation_scale(evidence: Evidence) -> Iterator[Remark]:
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
        factor = _power_of_ten(1.0 / (usual if usual > LARGE else largest))
        hint = f"scale: {factor:g}, or let the agent normalise (normalize_observations: true)"
        yield Remark("observation-scale", "warning", where, message, hint, {"usual": usual, "largest": largest})


def _columns(evidence: Evidence) -> Iterator[tuple[str, Tensor]]:
    """Each observation column, or picture, and its values in all lives. (columns, steps)"""
    env = evidence.lives[0].env
    for group in env.layout.observations:
        seen = torch.cat([life.obs[group].flatten(0, 1) for life in evidence.lives if group in life.obs]).t()
        for where, columns in observed(env, group):
            yield where, seen[columns].contiguous()


SATURATED = 0.8


def saturated_actions(evidence: Evidence) -> Iterator[Remark]:
    """Random actions within the bound mostly stay within what actuators can take."""
    (life,) = [life for life in evidence.lives if life.agent == "random"]
    for name, share in life.limited.items():
        if share >= SATURATED:
            yield Remark(
                "saturated-actions",
                "warning",
                name,
                f"is at its limit in {share:.0%} of the steps under random actions within +-{evidence.subject.bound:g}",
                "lower the action's scale (or the gain), or raise the limit: beyond it, actions differ in nothing",
                {"share": share},
            )


DEAD = 1e-6


def dead_actions(evidence: Evidence) -> Iterator[Remark]:
    """Every column of the action moves something."""
    env = evidence.env(8)
    env.reset(seed=0)
    start = env.state_dict()
    steps = max(5, math.ceil(0.1 / env.step_dt))
    bound = evidence.subject.bound
    # a column may multiply others, so that it moves nothing while they are 0
    others = [torch.full((8, env.layout.action_size), level * bound) for level in (0.0, 0.5)]
    without = [(action, _after(env, start, action, steps)) for action in others]
    names = [n for t in env.layout.actions for n in (t.elements if len(t.elements) == t.size else [t.name] * t.size)]
    for column, name in enumerate(names):
        moved = 0.0
        for (base, rest), sign in product(without, (1.0, -1.0)):
            action = base.clone()
            action[:, column] = sign * bound
            moved = max(moved, float((_after(env, start, action, steps) - rest).abs().max()))
            if moved > DEAD:
                break
        if moved <= DEAD:
            yield Remark(
                "dead-action",
                "error",
                f"actions, column {column} ({name})",
                f"moves nothing: after {steps} steps at +-{bound:g} the state differs by {moved:.1g}"
                " from that without action",
                "see that it drives the meant actuator, with a scale, a gear and a limit that are not 0",
                {"moved": moved, "steps": steps},
            )


def _after(env: VecEnv, start: dict[str, Tensor], action: Tensor, steps: int) -> Tensor:
    """Positions and velocities after some steps of one action. (num_envs, nq + nv)"""
    env.load_state_dict(start)
    for _ in range(steps):
        env.step(action.clone())
    return torch.cat([env.engine.field("qpos"), env.engine.field("qvel")], dim=1).double()


DRIFT, RATIO = 0.2, 1.5


def timestep(evidence: Evidence) -> Iterator[Remark]:
    """The physics time step is short enough: half of it shows the same energy and speeds, twice of it is stable."""
    dt = evidence.subject.resolved.task.sim.dt
    where = f"sim.dt = {dt:g} s"
    hint = "take a smaller sim.dt (and more decimation), more damping or armature, or lower gains and stiffnesses"
    diverged = {life.agent: life.diverged for life in evidence.lives if life.diverged}
    if diverged:
        agents = ", ".join(diverged)
        message = f"the simulation diverged {sum(diverged.values())} times (agents: {agents})"
        yield Remark("timestep", "error", where, message, hint, {"diverged": sum(diverged.values())})
        return
    env = evidence.env(8)
    env.reset(seed=0)
    for step in range(5):
        env.step(DUMMIES["random"](env, evidence.subject.bound)(step))
    drift = energy_drift(env)
    if drift.relative > DRIFT:
        message = (
            f"left to itself for {drift.seconds:.2g} s, the model's energy differs by {drift.relative:.0%} of what"
        )
        message += f" moves to and fro from that with steps of {dt / 2:g} s; up to {DRIFT:.0%} is usual"
        yield Remark("timestep", "warning", where, message, hint, {"energy_drift": drift.relative})
        return
    yield from _half_and_twice(evidence, dt, where, hint)


def _half_and_twice(evidence: Evidence, dt: float, where: str, hint: str) -> Iterator[Remark]:
    task = evidence.subject.resolved.task
    steps = max(10, min(evidence.steps, math.ceil(1.0 / task.step_dt)))
    bound = evidence.subject.bound
    as_is = live(evidence.env(16), "random", bound, steps)
    half = live(evidence.env(16, sim__dt=dt / 2, decimation=2 * task.decimation), "random", bound, steps)
    if as_is.error is None and half.error is None:
        a, b = as_is.speed, half.speed
        of_note = torch.maximum(a, b) > 0.05 * torch.maximum(a, b).max()
        ratio = torch.where(of_note & (torch.minimum(a, b) > 0.0), torch.maximum(a / b, b / a), 1.0)
        worst = int(ratio.argmax()) if len(ratio) else 0
        if len(ratio) and float(ratio[worst]) > RATIO:
            name = _velocity_name(as_is.env, worst)
            message = f"under random actions {name} moves at {float(a[worst]):.3g} (root mean square), and at"
            message += f" {float(b[worst]):.3g} with steps of {dt / 2:g} s; a factor of up to {RATIO:g} is usual"
            yield Remark("timestep", "warning", where, message, hint, {"ratio": float(ratio[worst])})
            return
    if 2 * dt > 0.1:
        return
    parts = task.decimation // 2 if task.decimation % 2 == 0 else task.decimation
    twice = live(evidence.env(16, sim__dt=2 * dt, decimation=parts), "random", bound, steps)
    if twice.diverged:
        message = (
            f"at twice the step the simulation diverges, {twice.diverged} times in {steps} steps: there is no room"
        )
        yield Remark("timestep", "warning", where, message, hint, {"diverged_at_twice": twice.diverged})


def _velocity_name(env: VecEnv, dof: int) -> str:
    model = env.engine.model
    return f"joint '{model.joint(int(model.dof_jntid[dof])).name}'"


NEAREST, FARTHEST = 0.05, 10.0


def horizon(evidence: Evidence) -> Iterator[Remark]:
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
        yield Remark(
            "horizon",
            "warning",
            f"agents.{name}.gamma = {gamma:g}",
            f"looks {ahead:.3g} steps ({ahead * resolved.task.step_dt:.2g} s) ahead, and an episode has {steps}"
            f" ({resolved.task.episode_length_s:g} s)",
            f"about {fitting:.3g} looks over a quarter of the episode",
            {"gamma": gamma, "horizon": ahead, "episode": steps},
        )


def discount_of(agent: AgentConfig | None) -> float | None:
    """The discount factor of an agent, wherever its trainer keeps it; None if it has none."""
    return None if agent is None else _find_gamma(agent.model_dump())


def _find_gamma(data: Any) -> float | None:
    if not isinstance(data, dict):
        return None
    for key in ("gamma", "discount", "discount_factor"):
        if isinstance(data.get(key), int | float):
            return float(data[key])
    return next((found for value in data.values() if (found := _find_gamma(value)) is not None), None)


RULES: dict[str, Callable[[Evidence], Iterable[Remark]]] = {
    "stops": stops,
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


def lint_task(
    task: str | Path,
    *,
    agent: str | None = None,
    overrides: Sequence[str] = (),
    seconds: float | None = None,
    only: Sequence[str] = (),
    ignore: Sequence[str] = (),
    on_rule: Callable[[str, list[Remark]], None] = lambda name, remarks: None,
) -> list[Remark]:
    """Look at what a task does under agents that know nothing.

    Args:
        task: a name from `list-tasks`, or a folder with a `task.yaml`.
        agent: whose patch of the task, action bound and discount hold; None takes the default agent.
        overrides: `key.path=value`, as on the command line.
        seconds: simulated time that each agent acts for [s]; None: an episode, but no more than 1000 steps.
        only: names of rules; all if empty.
        ignore: names of rules that are left out.
        on_rule: called after each rule with its name and remarks.

    Returns:
        What will get in the way of learning; empty for a task that is in order.

    Raises:
        UsageError: for a rule that does not exist.
        ConfigError: if the task is not valid; `rlcli validate --deep` says the same.
        TaskError: if there is no such task, or it cannot be imported.
    """
    for name in (*only, *ignore):
        if name not in RULES:
            raise UsageError(f"no rule '{name}'", hint=did_you_mean(name, RULES) or f"rules: {', '.join(RULES)}")
    if seconds is not None and not (math.isfinite(seconds) and seconds > 0.0):
        raise UsageError(f"--seconds {seconds:g} is not a time", hint="simulated seconds, above 0")
    path = Path(task)
    subject = Subject(find_task(str(path.resolve()) if isinstance(task, Path) else task), agent, overrides)
    evidence = Evidence(subject, seconds)
    found: list[Remark] = []
    with torch.random.fork_rng(devices=[]):
        for name in RULES:
            if (only and name not in only) or name in ignore:
                continue
            remarks = list(_judge(name, evidence))
            if evidence.stopped:  # what little there was of the lives says nothing
                remarks = list(stops(evidence))
            found += remarks
            on_rule(name, remarks)
            if evidence.stopped:
                break
    return found


def _judge(name: str, evidence: Evidence) -> Iterator[Remark]:
    try:
        yield from RULES[name](evidence)
    except (ConfigError, MachineError):
        raise
    except Exception as error:
        said = error.message if isinstance(error, RlcliError) else f"{type(error).__name__}: {error}"
        message = f"the rule was stopped by {' '.join(said.split())}"
        yield Remark(name, "error", evidence.subject.place(error), message, "mend what raises it, then lint again")


def _quantile(values: Tensor, share: float) -> float:
    """A quantile, of at most 100,000 of the values, evenly picked."""
    picked = values.flatten()[:: max(1, values.numel() // 100_000)]
    return float(picked.double().quantile(share))


def _mean(values: Sequence[float]) -> float:
    return sum(values) / max(1, len(values))


def _power_of_ten(value: float) -> float:
    """The nearest one to a positive number."""
    return 10.0 ** round(math.log10(value))

"""Rules of `rlcli lint`, each of which finds one obstacle to learning in the recorded rollouts of fixed policies.

A rule yields a remark for each obstacle; `RULES` has all rules by name.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import cycle, islice, product

import mujoco
import torch
from torch import Tensor

from rlcli.config.layers import leaves
from rlcli.config.schema import AgentConfig
from rlcli.envs.managed import ManagedEnv
from rlcli.envs.vec_env import VecEnv
from rlcli.testing.angle_rules import degrees, joint_limits
from rlcli.testing.findings import task_error_text
from rlcli.testing.fixed_policy_rollouts import FIXED_POLICIES, MAX_STEPS, RolloutEvidence, record_rollout
from rlcli.testing.remarks import Remark, error_at, warning_at
from rlcli.testing.start_rules import start_pose_falls
from rlcli.testing.task_under_test import observation_parts
from rlcli.testing.timestep_checks import energy_drift


def stops(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Check that the task raises no error under any fixed policy."""
    seen = set()
    for rollout in evidence.rollouts:
        if rollout.error is None:
            continue
        text = task_error_text(rollout.error)
        if text not in seen:
            seen.add(text)
            step = len(rollout.reward)
            message = f"the {rollout.policy} policy was stopped after {step} steps by {text}"
            hint = getattr(rollout.error, "hint", None) or "correct the code that raises this error, then lint again"
            yield error_at(evidence.subject.location(rollout.error), message, hint, {"step": step})


EARLY = 5
"""Number of steps up to which the end of an episode counts as early."""


def early_resets(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Check that under at least one fixed policy few episodes end in their first steps."""
    shares = {}
    for rollout in evidence.rollouts:
        early = [e for e in rollout.episodes if e.length <= EARLY < rollout.env.max_episode_length]
        count = len(rollout.episodes) + sum(length > EARLY for length in rollout.unfinished)
        shares[rollout.policy] = (len(early) / count if count else 0.0, early)
    share, early = min(shares.values(), key=lambda found: found[0])
    if share >= 0.1:
        causes = Counter(cause for episode in early for cause in episode.causes)
        names = ", ".join(name for name, _ in causes.most_common(2)) or "a reset"
        message = f"{share:.0%} of the episodes end within {EARLY} steps, under every fixed policy"
        hint = "choose start states that the termination allows (narrower reset ranges), or widen the termination's"
        hint += " limits"
        yield error_at(f"terminations: {names}", message, hint, {"share": share, "steps": EARLY})


def _weighted_terms(evidence: RolloutEvidence) -> list[str]:
    """Return the names of the reward terms with a nonzero weight."""
    rewards = evidence.subject.resolved.task.rewards
    env = evidence.rollouts[0].env
    if not isinstance(env, ManagedEnv):
        return []
    # a curriculum may raise a weight from 0, but a rollout is too short for that
    return [name for name, config in rewards.items() if config is not None and config.weight != 0.0]


def silent_reward(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Check that each reward term with a nonzero weight is nonzero in at least one step of the fixed policies."""
    if evidence.steps < min(evidence.subject.resolved.task.max_episode_length, MAX_STEPS):
        return  # a term may be other than 0 only at the end of an episode, which a shorter rollout does not reach
    steps = sum(rollout.reward.numel() for rollout in evidence.rollouts)
    for name in _weighted_terms(evidence):
        values = [rollout.terms[name] for rollout in evidence.rollouts if name in rollout.terms]
        if values and not any(bool(v.any()) for v in values):
            message = f"the term is 0 in all {steps} steps of {len(evidence.rollouts)} fixed policies"
            hint = "check the term's thresholds, joints and sensors, give it a softer slope, or remove the term"
            yield warning_at(f"rewards.{name}", message, hint, {"steps": steps})


DOMINANT = 0.99
"""Fraction of the sum of all terms' absolute values above which a reward term counts as dominant."""


def dominant_reward(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Check that no reward term is so large, under every fixed policy, that the other terms have no effect."""
    active = _weighted_terms(evidence)
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
            message = f"the term is {min(found):.1%} or more of the absolute reward under every fixed policy"
            message += f"; {others} have no effect"
            hint = "lower the term's weight, or raise the weights of the other terms"
            yield warning_at(f"rewards.{name}", message, hint, {"share": min(found)})


def constant_reward(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Check that the reward depends on the actions."""
    rewards = torch.cat([rollout.reward.flatten() for rollout in evidence.rollouts])
    if not rewards.numel() or not bool((rewards == rewards[0]).all()):
        return
    value = float(rewards[0])
    ends_early = any(bool(rollout.terminated.any()) for rollout in evidence.rollouts)
    if not ends_early or value == 0.0:  # with terminations, any other constant rewards long or short episodes
        reason = "" if ends_early else ", and no episode ends early"
        where = "rewards" if isinstance(evidence.rollouts[0].env, ManagedEnv) else "rew_buf"
        message = f"the reward is {value:g} in every step of every fixed policy{reason}, so there is nothing to learn"
        yield error_at(where, message, "compute the reward from the state or the action", {"value": value})


def dying_pays(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Check that a terminal step does not give more reward than good steps over the whole horizon of the agent."""
    running_steps, terminal_steps = [], []
    for rollout in evidence.rollouts:
        terminated = rollout.terminated.bool()
        running_steps.append(rollout.reward[~terminated & ~rollout.done.bool()])
        terminal_steps.append(rollout.reward[terminated])
    running, terminal = torch.cat(running_steps), torch.cat(terminal_steps)
    if len(terminal) < 10 or not len(running):
        return
    task = evidence.subject.resolved.task
    gamma = discount_of(evidence.subject.resolved.agent)
    gamma = 0.99 if gamma is None else gamma
    horizon = min(1.0 / max(1.0 - gamma, 1e-6), float(task.max_episode_length))
    good = _quantile(running, 0.9)  # a trained policy should reach what fixed policies reach in 10 % of their steps
    last = float(terminal.median())
    if good * horizon >= last:
        return
    finished = [e for rollout in evidence.rollouts for e in rollout.episodes]
    timed_out = [e.total for e in finished if not e.terminated]
    return_terminated = _mean([e.total for e in finished if e.terminated])
    numbers = {"good_step": good, "last_step": last, "horizon": horizon, "return_terminated": return_terminated}
    message = f"the reward of a good step is {good:.3g}, {good * horizon:.3g} over the agent's horizon of {horizon:.0f}"
    message += f" steps, and the reward of a terminal step is {last:.3g}"
    if timed_out:
        if return_terminated <= _mean(timed_out):
            return
        numbers["return_survived"] = _mean(timed_out)
        message += f"; the mean return of terminated episodes is {return_terminated:.3g}"
        message += f", of other episodes {_mean(timed_out):.3g}"
    if good > 0.0:
        hint = "lower the terminal reward; if the episode ends at the goal, use --ignore dying-pays"
        yield warning_at("rewards", message, hint, numbers)
        return
    hint = "reward every step (is_alive), make terms positive, or penalise terminations more (is_terminated)"
    yield error_at("rewards", message, hint, numbers)


LARGE, SMALL = 100.0, 0.01
"""Largest and smallest usual size of an observation column. The task `cart-double-pendulum` learns well although a
column is above 75 in 1 % of the steps."""


def constant_observation(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Check that every observation column varies under the fixed policies; of an image, at least one pixel."""
    for where, values in _columns(evidence):
        if bool((values == values[:, :1]).all()):
            low = float(values.min())
            value = f"the observation is {low:g}" if len(values) == 1 else "every pixel is the same"
            hint = "leave the column out, or compute it from the state"
            yield error_at(where, f"{value} in every step of every fixed policy", hint, {"value": low})


def observation_scale(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Check that observations have a size near 1, if the agent does not normalise them."""
    if getattr(evidence.subject.resolved.agent, "normalize_observations", False):
        return
    turning = _angles_without_limits(evidence.rollouts[0].env)
    for where, values in _columns(evidence):
        sizes = values.abs()
        usual, largest = _quantile(sizes, 0.99), float(sizes.max())
        if bool((values == values[:, :1]).all()) or (largest >= SMALL and usual <= LARGE):
            continue
        message = (
            f"the observation is never larger than {largest:.3g}; below {SMALL:g} a policy hardly notices it among"
            " other observations"
        )
        if usual > LARGE:
            message = f"the observation is larger than {usual:.3g} in 1 % of the steps; policies learn"
            message += f" well from sizes up to {LARGE:g}"
        factor = 10.0 ** round(math.log10(1.0 / (usual if usual > LARGE else largest)))
        hint = f"scale: {factor:g}, or let the agent normalise (normalize_observations: true)"
        if usual > LARGE and where in turning:
            hint = "each turn adds 2 pi: use func: joint_angle, which wraps angles, or terminate the episode earlier"
        yield warning_at(where, message, hint, {"usual": usual, "largest": largest})


def _angles_without_limits(env: VecEnv) -> set[str]:
    """Return the observation columns with angles of hinges without limits that are not wrapped to +-pi.

    Such an angle grows by 2 pi in each turn. The names are those of `observation_parts`.
    """
    found: set[str] = set()
    if not isinstance(env, ManagedEnv):
        return found
    model, _ = env.world(0)
    for group, terms in env.layout.observations.items():
        parts = iter(observation_parts(env, group))
        for term in terms:
            places = [where for where, _ in islice(parts, term.size if len(term.shape) < 2 else 1)]
            config = env.config.observations[group].terms[term.name]
            if config is None or config.func not in ("joint_pos", "joint_pos_rel"):
                continue
            entity = env.entities[config.params.get("entity", "robot")]
            joints = [entity.joint_ids[entity.joint_names.index(name)] for name in term.elements]
            turns = [model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE and not model.jnt_limited[j] for j in joints]
            found |= {where for where, turn in zip(places, cycle(turns)) if turn}
    return found


def _columns(evidence: RolloutEvidence) -> Iterator[tuple[str, Tensor]]:
    """Yield the name of each observation column or image, and its values in all rollouts.

    The values are (columns, steps): 1 row for a column, a row for each pixel and channel of an image.
    """
    env = evidence.rollouts[0].env
    for group in env.layout.observations:
        rollouts = [rollout.obs[group] for rollout in evidence.rollouts if group in rollout.obs]
        values = torch.cat([obs.flatten(0, 1) for obs in rollouts]).t()
        for where, columns in observation_parts(env, group):
            yield where, values[columns].contiguous()


SATURATED = 0.8
"""Fraction of the steps from which on a quantity that is at its limit in so many steps is reported."""


def saturated_actions(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Check that random actions within the bound mostly stay within the limits of the actuators."""
    (rollout,) = [rollout for rollout in evidence.rollouts if rollout.policy == "random"]
    hint = "lower the action's scale (or the gain), or raise the limit: actions beyond the limit have the same effect"
    for name, share in rollout.limited.items():
        if share >= SATURATED:
            bound = evidence.subject.bound
            message = f"the value is at its limit in {share:.0%} of the steps under random actions within +-{bound:g}"
            yield warning_at(name, message, hint, {"share": share})


DEAD = 1e-6
"""Largest change of a position or velocity that counts as no effect of an action."""


def dead_action(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Check that every column of the action changes the state."""
    env = evidence.env(8)
    env.reset(seed=env.seed)
    start = env.state_dict()
    steps = max(5, math.ceil(0.1 / env.step_dt))
    bound = evidence.subject.bound
    # a column may be a factor of others, and has no effect while they are 0
    bases = [torch.full((8, env.layout.action_size), level * bound) for level in (0.0, 0.5)]
    references = [(action, _state_after(env, start, action, steps)) for action in bases]
    names = [n for t in env.layout.actions for n in (t.elements if len(t.elements) == t.size else [t.name] * t.size)]
    for column, name in enumerate(names):
        moved = 0.0
        for (base, reference), sign in product(references, (1.0, -1.0)):
            action = base.clone()
            action[:, column] = sign * bound
            moved = max(moved, float((_state_after(env, start, action, steps) - reference).abs().max()))
            if moved > DEAD:
                break
        if moved <= DEAD:
            message = f"the action moves nothing: after {steps} steps at +-{bound:g} the state differs by {moved:.1g}"
            message += " from the state without this action"
            hint = "check the actuator of this column, and that scale, gear and limit are not 0"
            yield error_at(f"actions, column {column} ({name})", message, hint, {"moved": moved, "steps": steps})


def _state_after(env: VecEnv, start: dict[str, Tensor], action: Tensor, steps: int) -> Tensor:
    """Return positions and velocities after some steps with a constant action from `start`. (num_envs, nq + nv)

    `start` is a result of `env.state_dict()`.
    """
    env.load_state_dict(start)
    for _ in range(steps):
        env.step(action.clone())
    return torch.cat([env.engine.field("qpos"), env.engine.field("qvel")], dim=1).double()


DRIFT, RATIO = 0.2, 1.5
"""Largest usual difference between simulations with the time step and with half of it: relative error of the energy,
and ratio of speeds."""


def timestep(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Check that energy and speeds are the same with half the physics time step, and stable with twice the step."""
    dt = evidence.subject.resolved.task.sim.dt
    where = f"sim.dt = {dt:g} s"
    hint = "take a smaller sim.dt (and more decimation), more damping or armature, or lower gains and stiffnesses"
    diverged = {rollout.policy: rollout.diverged for rollout in evidence.rollouts if rollout.diverged}
    if diverged:
        names = ", ".join(diverged)
        message = f"the simulation diverged (fixed policies: {names}; number of divergences: {sum(diverged.values())})"
        yield error_at(where, message, hint, {"diverged": sum(diverged.values())})
        return
    env = evidence.env(8)
    env.reset(seed=env.seed)
    for step in range(5):
        env.step(FIXED_POLICIES["random"](env, evidence.subject.bound)(step))
    drift = energy_drift(env)
    if drift.relative > DRIFT:
        message = f"after {drift.seconds:.2g} s without actuators the energy of the model differs from the energy with"
        message += f" physics steps of {dt / 2:g} s by {drift.relative:.0%} of the energy exchanged between potential"
        message += f" and kinetic; up to {DRIFT:.0%} is usual"
        yield warning_at(where, message, hint, {"energy_drift": drift.relative})
        return
    yield from _compare_half_and_double_step(evidence, dt, where, hint)


def _compare_half_and_double_step(evidence: RolloutEvidence, dt: float, where: str, hint: str) -> Iterator[Remark]:
    task = evidence.subject.resolved.task
    steps = max(10, min(evidence.steps, math.ceil(1.0 / task.step_dt)))
    bound = evidence.subject.bound
    full = record_rollout(evidence.env(16), "random", bound, steps)
    half = record_rollout(evidence.env(16, sim__dt=dt / 2, decimation=2 * task.decimation), "random", bound, steps)
    if full.error is None and half.error is None:
        a, b = full.speed, half.speed
        is_fast = torch.maximum(a, b) > 0.05 * torch.maximum(a, b).max()
        ratio = torch.where(is_fast & (torch.minimum(a, b) > 0.0), torch.maximum(a / b, b / a), 1.0)
        worst = int(ratio.argmax()) if len(ratio) else 0
        if len(ratio) and float(ratio[worst]) > RATIO:
            model = full.env.engine.model
            name = f"joint '{model.joint(int(model.dof_jntid[worst])).name}'"
            message = f"under random actions {name} moves at {float(a[worst]):.3g} (root mean square), and at"
            message += f" {float(b[worst]):.3g} with physics steps of {dt / 2:g} s; a factor up to {RATIO:g} is usual"
            yield warning_at(where, message, hint, {"ratio": float(ratio[worst])})
            return
    if 2 * dt > 0.1:
        return
    decimation = task.decimation // 2 if task.decimation % 2 == 0 else task.decimation
    twice = record_rollout(evidence.env(16, sim__dt=2 * dt, decimation=decimation), "random", bound, steps)
    if twice.diverged:
        message = (
            f"with twice the time step, {2 * dt:g} s, the simulation diverges within {steps} steps,"
            " so the time step is close to the largest stable one"
        )
        yield warning_at(where, message, hint, {"diverged_at_twice": twice.diverged})


NEAREST, FARTHEST = 0.05, 10.0
"""Smallest and largest usual horizon, as a share of the episode length."""


def horizon(evidence: RolloutEvidence) -> Iterator[Remark]:
    """Check that the agent's horizon, 1 / (1 - gamma) steps, is comparable to the length of an episode."""
    for name, resolved in evidence.subject.agents().items():
        gamma = discount_of(resolved.agent)
        if gamma is None:
            continue
        steps = resolved.task.max_episode_length
        ahead = math.inf if gamma >= 1.0 else 1.0 / (1.0 - gamma)
        if NEAREST <= round(ahead / steps, 9) <= FARTHEST:  # rounded: 1 / (1 - 0.99) is a little less than 100
            continue
        fitting = 1.0 - 1.0 / max(2.0, 0.25 * steps)
        message = f"this gamma gives a horizon of {ahead:.3g} steps ({ahead * resolved.task.step_dt:.2g} s)"
        message += f", and an episode has {steps} steps ({resolved.task.episode_length_s:g} s)"
        numbers = {"gamma": gamma, "horizon": ahead, "episode": steps}
        hint = f"gamma = {fitting:.3g} gives a horizon of a quarter of the episode"
        yield warning_at(f"agents.{name}.gamma = {gamma:g}", message, hint, numbers)


def discount_of(agent: AgentConfig | None) -> float | None:
    """Return the discount factor in an agent's settings, even if nested; None if the agent has none, or is None."""
    if agent is None:
        return None
    settings = sorted(leaves(agent.model_dump()), key=lambda leaf: len(leaf[0]))  # the least nested value comes first
    discounts = (v for path, v in settings if path and path[-1] in ("gamma", "discount", "discount_factor"))
    return next((float(value) for value in discounts if isinstance(value, int | float)), None)


_IN_ORDER: tuple[Callable[[RolloutEvidence], Iterable[Remark]], ...] = (
    *(stops, early_resets, silent_reward, dominant_reward, constant_reward, dying_pays, constant_observation),
    *(observation_scale, saturated_actions, dead_action, timestep, horizon, degrees, joint_limits, start_pose_falls),
)
RULES = {rule.__name__.replace("_", "-"): rule for rule in _IN_ORDER}
"""Name -> rule, in the order in which the rules run; `docs/guides/check-and-lint.md` lists all rules.

The first line of a rule's docstring is the rule."""


def _quantile(values: Tensor, share: float) -> float:
    """Return a quantile of some values, computed from at most about 100,000 of them at equal distances.

    Args:
        values: a tensor of any shape.
        share: the share of the values below the quantile, 0 to 1.
    """
    sample = values.flatten()[:: max(1, values.numel() // 100_000)]  # torch's quantile limits the number of values
    return float(sample.double().quantile(share))


def _mean(values: Sequence[float]) -> float:
    return sum(values) / max(1, len(values))

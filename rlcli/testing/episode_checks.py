"""Checks of episodes: seeds, start states, ends and partial resets. One function for each clause of the contract."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from rlcli.envs.managed import ManagedEnv
from rlcli.envs.step import StepResult
from rlcli.envs.vec_env import VecEnv
from rlcli.testing.task_under_test import (
    NUM_ENVS,
    Finding,
    NotRunError,
    TaskUnderTest,
    bitwise_equal,
    column_names,
    engine_state,
    error_at,
    expire_episodes,
    random_actions,
    record_trajectory,
    step_outputs,
    task_of,
    warning_at,
)

_ENDING = [1, 4, 5]
"""Environments whose episodes are ended while the others run on."""
_RUNNING = [row for row in range(NUM_ENVS) if row not in _ENDING]
_LIMITS = (6, 9)
"""Episode lengths that show whether an end follows the limit [steps]."""


def same_seed(subject: TaskUnderTest) -> Iterator[Finding]:
    """The same seed and actions give the same trajectory, in a new environment and after reset(seed)."""
    steps = 30
    env, other = subject.env(episode_steps=12), subject.env(episode_steps=12)
    first = record_trajectory(env, random_actions(env, subject.bound, steps))
    trajectories = (
        ("two new environments", record_trajectory(other, random_actions(other, subject.bound, steps)), _RANDOM),
        (
            "a new environment, and the same one after reset(seed)",
            record_trajectory(env, random_actions(env, subject.bound, steps)),
            _MEMORY,
        ),
    )
    for what, trajectory, hint in trajectories:
        difference = first_difference(env, first, trajectory)
        if difference is not None:
            where, message = difference
            yield error_at(where, f"differs between {what}, one seed and one set of actions: {message}", hint)
            return


_RANDOM = (
    "draw from the selection (uniform, normal, choice) or from self.draws(env_ids) instead of torch.rand, numpy or time"
)
_MEMORY = "something outlives the episode: clear it in the term's reset(selection), or in reset_idx"


def first_difference(
    env: VecEnv, left: list[dict[str, Tensor]], right: list[dict[str, Tensor]]
) -> tuple[str, str] | None:
    """Return where two trajectories differ first, and how; None if they are equal bit for bit."""
    for step, (a, b) in enumerate(zip(left, right, strict=True)):
        for what in a:
            if not bitwise_equal(a[what], b[what]):
                return _difference(env, what, a[what], b[what], f"after {step} steps")
    return None


def _difference(env: VecEnv, what: str, a: Tensor, b: Tensor, when: str) -> tuple[str, str]:
    place = (a != b).nonzero()[0].tolist()
    row, column = place[0], place[1:]
    group = what.split("'")[1] if "'" in what else ""
    name = f", column {column[0]} ({column_names(env, group)[column[0]]})" if group and column else ""
    values = f"{float(a[tuple(place)]):.7g} and {float(b[tuple(place)]):.7g}"
    return f"{what}{name}", f"{values} in environment {row}, {when}"


def start_states(subject: TaskUnderTest) -> Iterator[Finding]:
    """Episodes start in states that vary, between environments and from one episode to the next."""
    env = subject.env()
    first = _start(env, env.reset(seed=0))
    second = _start(env, env.reset())
    hint = "add an event of mode reset with a range (reset_joints_by_offset), or draws(env_ids).uniform in reset_idx"
    if bool((first == first[0]).all()):
        message = f"the start states of {NUM_ENVS} environments are all the same; they must vary"
        yield error_at("between environments", message, hint)
    if bitwise_equal(first, second):
        message = "two episodes in a row start in the same states; they must vary"
        yield error_at("between episodes", message, hint)


def _start(env: VecEnv, obs: dict[str, Tensor]) -> Tensor:
    parts = [*obs.values(), *engine_state(env).values()]
    return torch.cat([part.reshape(env.num_envs, -1).double() for part in parts], dim=1)


@dataclass(slots=True)
class _EnvPair:
    """Two environments with the same past: some episodes end in `ended` and continue in `kept`."""

    kept: VecEnv
    ended: VecEnv
    actions: list[Tensor]
    taken: int = 0

    def step(self) -> tuple[StepResult, StepResult]:
        action, self.taken = self.actions[self.taken], self.taken + 1
        results = []
        for env in (self.kept, self.ended):
            torch.manual_seed(self.taken)  # what a task draws from torch itself is same-seed's business
            results.append(env.step(action.clone()))
        return results[0], results[1]


def _env_pair(subject: TaskUnderTest) -> _EnvPair:
    """Return a pair that has made some steps; in the next step some episodes of `ended` end."""
    kept, ended = subject.env(episode_steps=50), subject.env(episode_steps=50)
    pair = _EnvPair(kept, ended, list(random_actions(kept, subject.bound, 11)))
    for env in (kept, ended):
        torch.manual_seed(0)
        env.reset(seed=0)
    for _ in range(5):
        pair.step()
    expire_episodes(ended, _ENDING)
    return pair


def partial_reset(subject: TaskUnderTest) -> Iterator[Finding]:
    """A reset of some environments leaves all others as they are, bit for bit."""
    pair = _env_pair(subject)
    for number in range(6):
        kept, ended = pair.step()
        pairs = {name: (value, engine_state(pair.ended)[name]) for name, value in engine_state(pair.kept).items()}
        pairs |= {name: (value, step_outputs(ended)[name]) for name, value in step_outputs(kept).items()}
        for what, (a, b) in pairs.items():
            if bitwise_equal(a[_RUNNING], b[_RUNNING]):
                continue
            rows = [row for row in _RUNNING if not bitwise_equal(a[row], b[row])]
            where = "the simulation's state" if what == "state" else what
            yield error_at(
                where,
                f"of environments {rows} changed when {_ENDING} were reset"
                + (f", {number} steps later" if number else "")
                + "; they must stay bit-identical",
                "write only the rows you are given (the selection, env_ids), and average over no other environment",
            )
            return


def final_observations(subject: TaskUnderTest) -> Iterator[Finding]:
    """An ended episode's last observation is given, and is not the new episode's first."""
    result = _env_pair(subject).step()[1]
    over = (result.terminated | result.truncated)[_ENDING]
    if not bool(over.all()):
        return  # truncation says so
    if result.final_obs is None:
        message = f"the episodes of environments {_ENDING} ended without final observations"
        yield error_at("final_obs", message, "the framework gives them: report this")
        return
    for group, values in result.final_obs.items():
        stale = [row for row in _ENDING if bitwise_equal(values[row], result.obs[group][row])]
        if stale:
            yield error_at(
                f"observations.{group}",
                f"the first observation of the new episode is the last of the old one in environments {stale}",
                "compute observations from the state each time they are asked for, and let the reset change the state",
            )


@dataclass(frozen=True, slots=True)
class _EpisodeEnd:
    length: int
    terminated: bool
    truncated: bool
    causes: tuple[str, ...]


def _episode_ends(subject: TaskUnderTest, limit: int) -> list[_EpisodeEnd]:
    """Two episodes' time without an action, in episodes of `limit` steps."""
    env = subject.env(episode_steps=limit)
    env.reset(seed=0)
    ends = []
    for _ in range(2 * limit + 2):
        result = env.step(torch.zeros(NUM_ENVS, env.layout.action_size))
        episodes = result.episodes.ended() if result.episodes else None
        for row, number in enumerate(episodes.ids.tolist() if episodes else []):
            assert episodes is not None
            fired = tuple(name for name, mask in episodes.causes.items() if bool(mask[row]))
            flags = bool(result.terminated[number]), bool(result.truncated[number])
            ends.append(_EpisodeEnd(int(episodes.lengths[row]), *flags, fired))
        if bool((env.episode_length_buf >= limit).any()):
            ends.append(_EpisodeEnd(limit + 1, False, False, ()))
            break
    return ends


def back_fill(subject: TaskUnderTest) -> Iterator[Finding]:
    """A new episode's first observation holds nothing of the old one: histories, delays and buffers are filled anew."""
    require_independent_episodes(subject)
    env, other = subject.env(episode_steps=50), subject.env(episode_steps=50)
    for one in (env, other):
        torch.manual_seed(0)
        one.reset(seed=0)
    for number, action in enumerate(random_actions(env, subject.bound, 6)):
        if number == 5:
            expire_episodes(env, _ENDING)
            expire_episodes(other, _ENDING)
        results = []
        for one, given in ((env, action), (other, -0.5 * action)):
            torch.manual_seed(number)
            results.append(one.step(given.clone()))
    alike = env.episode_index == other.episode_index  # an end of the task's own may have come before
    rows = [row for row in _ENDING if bool(alike[row])]
    for group, first in results[0].obs.items():
        second = first.clone()
        second[rows] = results[1].obs[group][rows]
        if not bitwise_equal(first, second):
            where, message = _difference(env, f"observation '{group}'", first, second, "at its start")
            yield error_at(
                where,
                f"an episode's first one depends on what was done in the episode before: {message}",
                "fill histories, delays and buffers anew for the environments that are reset, in reset(selection) or"
                " reset_idx",
            )


def require_independent_episodes(subject: TaskUnderTest) -> None:
    """Check that an episode does not depend on the one before: else two trajectories cannot be compared.

    Raises:
        NotRunError: then.
    """
    task = subject.resolved.task
    if task.scene.terrain is not None:
        raise NotRunError("on a terrain an episode starts where the one before led to")
    if task.curriculum:
        raise NotRunError("a curriculum may let an episode depend on the one before")


def truncation(subject: TaskUnderTest) -> Iterator[Finding]:
    """An episode that lives so long is truncated at episode_length_s, not a step earlier or later."""
    hint = "declare `time_out: {func: time_out, time_out: true}` among the terminations, and compare with >="
    early: list[set[int]] = []
    for limit in _LIMITS:
        ends = _episode_ends(subject, limit)
        where = f"episode_length_s of {limit} steps"
        if any(end.length > limit for end in ends):
            message = f"episodes run on after step {limit}; allowed is truncation at exactly {limit}"
            yield error_at(where, message, hint)
            return
        if any(end.length == limit and not end.truncated for end in ends):
            message = f"episodes end at step {limit} without being truncated; a time-out must be reported as one"
            yield error_at(where, message, hint)
            return
        early.append(
            {limit - end.length for end in ends if end.truncated and not end.terminated and end.length < limit}
        )
        if not early[-1] and not any(end.length == limit for end in ends):
            message = f"no episode reached its limit without actions: the first ones ended after {ends[0].length} steps"
            yield warning_at(where, message, "make starts that last a few steps, so that it can be seen")
            return
    if early[0] and early[0] == early[1] and len(early[0]) == 1:
        message = f"every episode is truncated {early[0].pop()} steps before its limit; allowed is exactly at it"
        yield error_at("terminations", message, hint)
    elif any(early):
        message = "some episodes are truncated before their limit"
        yield warning_at("terminations", message, "`time_out: true` is for ends that say nothing of the state")


def termination(subject: TaskUnderTest) -> Iterator[Finding]:
    """A time-out is not a termination: the task's own end does not come with the clock."""
    hint = "declare it with `time_out: true`, or leave the clock to the framework and out of is_done"
    seen = {limit: _episode_ends(subject, limit) for limit in _LIMITS}
    for before in (0, 1):
        reached = [[e for e in ends if e.length >= limit - before] for limit, ends in seen.items()]
        by_clock = [
            len(ends) >= NUM_ENVS and all(e.terminated and e.length == limit - before for e in ends)
            for limit, ends in zip(seen, reached, strict=True)
        ]
        if all(by_clock):
            causes = dict.fromkeys(c for ends in reached for e in ends for c in e.causes if not _declared(subject, c))
            when = "at their limit" if before == 0 else "one step before their limit"
            steps = " and at ".join(str(limit - before) for limit in _LIMITS)
            message = f"all episodes that live so long are terminated exactly {when}, at {steps} steps"
            yield error_at(f"terminations: {', '.join(causes)}", message, hint)
            return
    recording = subject.recording()
    ended = [s.episodes for s in recording.steps if s.episodes is not None]
    lengths = [n for e in ended for n, out in zip(e.lengths.tolist(), e.truncated.tolist(), strict=True) if not out]
    if len(lengths) >= NUM_ENVS and len(set(lengths)) == 1 and lengths[0] > 1:
        message = f"all {len(lengths)} terminations under random actions came after exactly {lengths[0]} steps: a clock"
        yield warning_at("terminations", message, hint)


def _declared(subject: TaskUnderTest, cause: str) -> bool:
    term = subject.resolved.task.terminations.get(cause)
    return bool(term.time_out) if term is not None else cause == "time_out"


def repeated_observation(subject: TaskUnderTest) -> Iterator[Finding]:
    """Observing the same state a second time gives the same."""
    hint = "compute it from the state alone; advance histories and counters when actions are applied"
    for what, (before, after) in _observe_twice(_env_pair(subject)).items():
        if not bitwise_equal(before, after):
            message = "changes when it is computed a second time in the same state"
            yield error_at(what, message, hint)


def _observe_twice(pair: _EnvPair) -> dict[str, tuple[Tensor, Tensor]]:
    env = pair.kept
    memory = env.observation_manager.state_dict() if isinstance(env, ManagedEnv) else {}
    result = pair.step()[0]
    if isinstance(env, ManagedEnv):
        obs = {group: values.clone() for group, values in result.obs.items()}
        running = ~(result.terminated | result.truncated)
        env.observation_manager.load_state_dict(memory)  # histories and filters look at the same past again
        again = env.observation_manager.compute()
        return {f"observations.{group}": (values[running], again[group][running]) for group, values in obs.items()}
    task = task_of(env)
    first = {"obs_buf": task.obs_buf.clone(), "states_buf": task.states_buf.clone()}
    env._fill_buffers()  # type: ignore[attr-defined]
    return {name: (values, getattr(task, name)) for name, values in first.items()}


def observation_after_reset(subject: TaskUnderTest) -> Iterator[Finding]:
    """A direct task observes running environments alike before and after others are reset."""
    pair = _env_pair(subject)
    task, seen = task_of(pair.ended), []
    observe = task.get_observations

    def watched() -> object:
        result = observe()
        seen.append(task.obs_buf.clone())
        return result

    task.get_observations = watched  # type: ignore[method-assign]
    result = pair.step()[1]
    over = (result.terminated | result.truncated).tolist()
    running = [row for row in _RUNNING if not over[row]]  # some may end by themselves just now
    for before, after in pairwise(seen):
        rows = [row for row in running if not bitwise_equal(before[row], after[row])]
        if rows:
            yield error_at(
                "obs_buf",
                f"of running environments {rows} changes when {_ENDING} are reset",
                "compute each row from its own environment's state",
            )
            return

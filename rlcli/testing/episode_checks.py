"""Checks of `rlcli check` about episodes: seeds, start states, ends and partial resets.

Each function checks one requirement that every task must meet.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import torch
from torch import Tensor

from rlcli.envs.managed import ManagedEnv
from rlcli.envs.step_result import StepResult
from rlcli.envs.vec_env import VecEnv
from rlcli.testing.findings import Finding, NotRunError, error_at, warning_at
from rlcli.testing.steps import (
    EndedEpisode,
    ended_episodes,
    equal_values,
    random_actions,
    record_outputs,
    step_outputs,
)
from rlcli.testing.task_under_test import TaskUnderTest, column_names, engine_state, expire_episodes, task_of

_ENDING = [1, 4, 5]
"""Indices of the environments whose episodes a check ends, while the episodes of the other environments continue."""
_LIMITS = (6, 9)
"""Two time limits [steps] that a check sets: an episode that ends exactly at both limits ends because of the limit."""

Trajectory = list[dict[str, Tensor]]
"""Outputs of each step: name, such as `reward` -> tensor with one row for each environment."""
MakeFinding = Callable[[str, str, str], Finding]
"""Type of the functions `error_at` and `warning_at`, which return a finding with (where, message, hint)."""


def same_seed(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that the same seed and actions give the same trajectory, in a new environment and after reset(seed).

    If torch's generator alone explains a difference of another framework's task, the finding is a warning: code for
    other frameworks has no other generator, and trainings seed it.
    """
    findings = _seed_differences(subject)
    if findings and subject.resolved.format is not None:
        others = _seed_differences(subject, seeds_torch=True)
        hint = "nothing to do: a training seeds torch's generator, so that the same --seed repeats the training"
        findings = others or [
            warning_at(each.where, f"{each.message} (from torch's generator)", hint) for each in findings
        ]
    yield from findings


def _seed_differences(subject: TaskUnderTest, seeds_torch: bool = False) -> list[Finding]:
    """Return the first difference between trajectories with the same seed and actions.

    Args:
        subject: the task.
        seeds_torch: whether each environment and each trajectory starts with the same state of torch's generator.
    """

    def seed() -> None:
        if seeds_torch:
            torch.manual_seed(0)

    envs = []
    for _ in range(2):
        seed()
        envs.append(subject.env(episode_steps=12))
    env, other = envs
    trajectories = []
    for each in (env, other, env):
        seed()
        trajectories.append(record_outputs(each, random_actions(each, subject.bound, 30)))
    first, second, third = trajectories
    message = "this output of the step differs between two new environments with the same seed and actions"
    hint = "sample with selection.uniform (normal, choice) or self.draws(env_ids), not with torch.rand or numpy or time"
    findings = list(compare_trajectories(env, (first, second), message, hint))
    if not findings:
        message = "this output of the step differs between a new environment and the same environment after reset(seed)"
        hint = "clear all state of the last episode in the term's reset(selection), or in reset_idx"
        findings = list(compare_trajectories(env, (first, third), message, hint))
    return findings


def compare_trajectories(
    env: VecEnv, trajectories: Sequence[Trajectory], message: str, hint: str, make: MakeFinding = error_at
) -> Iterator[Finding]:
    """Report the first difference of two trajectories, if they are not equal bit for bit.

    Args:
        env: an environment with the layout (names of columns) of the trajectories.
        trajectories: both trajectories, equally long.
        message: message of the finding; the differing values are appended.
        hint: hint of the finding.
        make: `error_at` or `warning_at`.
    """
    for step, (a, b) in enumerate(zip(*trajectories, strict=True)):
        for name in a:
            if not equal_values(a[name], b[name]):
                where, values = _difference(env, name, a[name], b[name], f"after {step} steps")
                yield make(where, f"{message}: {values}", hint)
                return


def _difference(env: VecEnv, output: str, a: Tensor, b: Tensor, when: str) -> tuple[str, str]:
    """Return two texts for a finding: the first place at which two tensors differ, and both values there.

    Args:
        env: an environment with the layout of the tensors.
        output: name of the tensors, such as `observation 'policy'`.
        a: a tensor with one row for each environment.
        b: the tensor to compare it with.
        when: the step, for the text.
    """
    index = (a != b).nonzero()[0].tolist()
    row, column = index[0], index[1:]
    group = output.split("'")[1] if "'" in output else ""
    name = f", column {column[0]} ({column_names(env, group)[column[0]]})" if group and column else ""
    values = f"{float(a[tuple(index)]):.7g} and {float(b[tuple(index)]):.7g}"
    return f"{output}{name}", f"{values} in environment {row}, {when}"


def start_states(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that start states differ between environments and between episodes."""
    env = subject.env()
    first = _start(env, env.reset(seed=env.seed))
    second = _start(env, env.reset())
    hint = "add an event of mode reset with a range (reset_joints_by_offset), or draws(env_ids).uniform in reset_idx"
    if bool((first == first[0]).all()):
        message = f"the start states of {env.num_envs} environments are all the same; start states must vary"
        yield error_at("between environments", message, hint)
    if equal_values(first, second):
        message = "two episodes in a row start in the same states; start states must vary"
        yield error_at("between episodes", message, hint)
    with contextlib.suppress(Exception):  # other checks report the error of a step
        env.step(torch.zeros(env.num_envs, env.layout.action_size))
        held = [name for name, share in env.condition_shares().items() if share == 1.0]
        if held:
            subject.notes["start-states"] = (
                f"success: {', '.join(held)} holds already after the first step in all {env.num_envs} environments;"
                " this is right if the policy must keep a state, and wrong if it must reach a goal"
            )


def _start(env: VecEnv, obs: dict[str, Tensor]) -> Tensor:
    """Return the observations of a reset and the engine's state as one tensor. (num_envs, number of values)"""
    parts = [*obs.values(), *engine_state(env).values()]
    return torch.cat([part.reshape(env.num_envs, -1).double() for part in parts], dim=1)


class _EnvPair:
    """Two objects of a task's environments, `kept` and `ended`, with equal states until a check makes them differ.

    Args:
        subject: the task.
        scale: factor of the random actions in `ended`; with 1 both get the same actions.
        keeps_torch: whether the ends and resets of episodes leave torch's generator unchanged.
    """

    def __init__(self, subject: TaskUnderTest, scale: float = 1.0, keeps_torch: bool = False) -> None:
        self.kept, self.ended = subject.env(episode_steps=50), subject.env(episode_steps=50)
        self._actions, self._steps, self._scale = random_actions(self.kept, subject.bound), 0, scale
        self.drew_differently = False
        """Whether `kept` and `ended` drew different numbers from torch's generator in a step."""
        for env in (self.kept, self.ended):
            torch.manual_seed(0)
            env.reset(seed=env.seed)
            if keeps_torch:
                keep = torch.random.fork_rng(devices=[])
                env._compute_final_obs = keep(env._compute_final_obs)  # type: ignore[method-assign]
                env._reset_ended = keep(env._reset_ended)  # type: ignore[method-assign]

    def step(self, count: int = 1) -> tuple[StepResult, StepResult]:
        """Step `kept` and `ended` with the next random actions, `count` times; return both results of the last step."""
        for _ in range(count):
            action = next(self._actions)
            self._steps += 1
            results, generators = [], []
            for env, factor in ((self.kept, 1.0), (self.ended, self._scale)):
                torch.manual_seed(self._steps)  # draws from torch's own generator are checked by `same-seed`
                results.append(env.step(factor * action))
                generators.append(torch.get_rng_state())
            self.drew_differently |= not torch.equal(*generators)
        return results[0], results[1]


def _env_pair(subject: TaskUnderTest, keeps_torch: bool = False) -> _EnvPair:
    """Return a pair in equal states, for checks of partial resets; see `_EnvPair` for `keeps_torch`.

    In the next step the episodes of the environments `_ENDING` reach their time limit in `ended`, but not in `kept`.
    """
    pair = _EnvPair(subject, keeps_torch=keeps_torch)
    pair.step(5)
    expire_episodes(pair.ended, _ENDING)
    return pair


def partial_reset(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that a reset of some environments leaves the others bit-identical.

    If draws from torch's generator explain a difference of another framework's task, the finding is a warning: the
    numbers that a reset draws are missing for the other environments, as in that framework.
    """
    found = _changed_by_reset(_env_pair(subject))
    if found is not None and subject.resolved.format is not None:
        pair = _env_pair(subject, keeps_torch=True)
        other = _changed_by_reset(pair)
        if other is None or pair.drew_differently:
            hint = "nothing to do: all environments draw from one generator, so that a reset changes later draws"
            yield warning_at(found.where, f"{found.message} (code of the task draws from torch's generator)", hint)
            return
        found = other
    if found is not None:
        yield found


def _changed_by_reset(pair: _EnvPair) -> Finding | None:
    """Return the first difference between `kept` and `ended` in environments that did not reset; None: none."""
    for number in range(6):
        kept, ended = pair.step()
        pairs = {name: (value, engine_state(pair.ended)[name]) for name, value in engine_state(pair.kept).items()}
        pairs |= {name: (value, step_outputs(ended)[name]) for name, value in step_outputs(kept).items()}
        for name, (a, b) in pairs.items():
            rows = [row for row in range(pair.kept.num_envs) if row not in _ENDING and not equal_values(a[row], b[row])]
            if rows:
                later = f", {number} steps later" if number else ""
                where = "the simulation's state" if name == "state" else name
                message = f"values of environments {rows} changed when environments {_ENDING} were reset{later}"
                hint = "write only to the rows of the environments that reset (`selection` or `env_ids`), and use no"
                hint += " averages over environments"
                return error_at(where, f"{message}; these values must stay bit-identical", hint)
    return None


def final_observations(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that a step returns the last observation of an ended episode, not the first observation of the next."""
    result = _env_pair(subject).step()[1]
    done = (result.terminated | result.truncated)[_ENDING]
    if not bool(done.all()):
        return  # the check `truncation` reports this problem
    if result.final_obs is None:
        message = f"the episodes of environments {_ENDING} ended without final observations"
        yield error_at("final_obs", message, "this is a defect of rlcli: please report it")
        return
    for group, values in result.final_obs.items():
        stale = [row for row in _ENDING if equal_values(values[row], result.obs[group][row])]
        if stale:
            message = f"the first observation of a new episode equals the last of the old one in environments {stale}"
            hint = "compute observations from the state at every call, and let the reset change the state"
            yield error_at(f"observations.{group}", message, hint)


def _episode_ends(subject: TaskUnderTest, limit: int) -> list[EndedEpisode]:
    """Return how episodes with a time limit of `limit` steps end under zero actions, in about 2 * `limit` steps.

    If an episode exceeds the limit, the last item has the length `limit + 1`.
    """
    env = subject.env(episode_steps=limit)
    env.reset(seed=env.seed)
    ends = []
    for _ in range(2 * limit + 2):
        ends += ended_episodes(env.step(torch.zeros(env.num_envs, env.layout.action_size)))
        if bool((env.episode_length_buf >= limit).any()):
            ends.append(EndedEpisode(0, limit + 1, False, False, ()))
            break
    return ends


def back_fill(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that the first observation of an episode has no values of the previous episode in histories and buffers."""
    task = subject.resolved.task
    if task.scene.terrain is not None:
        raise NotRunError("on terrain the start of an episode depends on the previous one: nothing to compare")
    if task.curriculum:
        raise NotRunError("with a curriculum an episode may depend on the previous one: nothing to compare")
    pair = _EnvPair(subject, scale=-0.5)
    pair.step(5)
    for env in (pair.kept, pair.ended):
        expire_episodes(env, _ENDING)
    results = pair.step()
    # a termination of the task may have ended an episode earlier in only one of the two environments
    same_episode = pair.kept.episode_index == pair.ended.episode_index
    rows = [row for row in _ENDING if bool(same_episode[row])]
    for group, first in results[0].obs.items():
        second = first.clone()
        second[rows] = results[1].obs[group][rows]
        if not equal_values(first, second):
            where, values = _difference(pair.kept, f"observation '{group}'", first, second, "at its start")
            message = f"the first observation of an episode depends on the actions of the episode before: {values}"
            hint = "fill histories, delays and buffers of the reset environments in reset(selection) or reset_idx"
            yield error_at(where, message, hint)


def truncation(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that an episode that is not terminated is truncated at episode_length_s, not a step earlier or later."""
    hint = "declare `time_out: {func: time_out, time_out: true}` among the terminations, and compare with >="
    early: list[set[int]] = []
    for limit in _LIMITS:
        ends = _episode_ends(subject, limit)
        where = f"episode_length_s of {limit} steps"
        if any(end.length > limit for end in ends):
            message = f"episodes continue after step {limit}; they must be truncated at exactly step {limit}"
            yield error_at(where, message, hint)
            return
        if any(end.length == limit and not end.truncated for end in ends):
            message = f"episodes end at step {limit} without being truncated; a time-out must be reported as truncation"
            yield error_at(where, message, hint)
            return
        truncated = [end for end in ends if end.truncated and not end.terminated]
        early.append({limit - end.length for end in truncated if end.length < limit})
        if not early[-1] and not any(end.length == limit for end in ends):
            message = f"no episode reached its limit with zero actions: the first ended after {ends[0].length} steps"
            yield warning_at(where, message, "choose start states whose episodes last some steps under zero actions")
            return
    if early[0] and early[0] == early[1] and len(early[0]) == 1:
        count = early[0].pop()
        steps = f"{count} step{'s' if count > 1 else ''}"
        message = f"every episode is truncated {steps} before its limit"
        if count == 1 and subject.resolved.format is not None:
            hint = "usual in the task's framework; for the full length compare the step with `>= max_episode_length`"
            yield warning_at("terminations", message, hint)
        else:
            yield error_at("terminations", f"{message}; it must be truncated at its limit", hint)
    elif any(early):
        message = "some episodes are truncated before their limit"
        yield warning_at("terminations", message, "use `time_out: true` only for ends that do not depend on the state")


def termination(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that no time-out is reported as a termination."""
    hint = "declare the termination with `time_out: true`, or leave the time limit to rlcli and remove it from is_done"
    ends_of = {limit: _episode_ends(subject, limit) for limit in _LIMITS}
    for before in (0, 1):
        reached = [[e for e in ends if e.length >= limit - before] for limit, ends in ends_of.items()]
        by_clock = [
            len(ends) >= subject.num_envs and all(e.terminated and e.length == limit - before for e in ends)
            for limit, ends in zip(ends_of, reached, strict=True)
        ]
        if all(by_clock):
            causes = dict.fromkeys(c for ends in reached for e in ends for c in e.causes if not _declared(subject, c))
            when = "at their limit" if before == 0 else "one step before their limit"
            steps = " and at ".join(str(limit - before) for limit in _LIMITS)
            message = f"all episodes that are not terminated earlier are terminated exactly {when}, at {steps} steps"
            yield error_at(f"terminations: {', '.join(causes)}", message, hint)
            return
    ended = [result.episodes for result in subject.recording().steps if result.episodes is not None]
    lengths = [n for e in ended for n, out in zip(e.lengths.tolist(), e.truncated.tolist(), strict=True) if not out]
    if len(lengths) >= subject.num_envs and len(set(lengths)) == 1 and lengths[0] > 1:
        message = f"all {len(lengths)} terminations under random actions came after exactly {lengths[0]} steps"
        message += ", as a time-out would"
        yield warning_at("terminations", message, hint)


def _declared(subject: TaskUnderTest, cause: str) -> bool:
    """Return whether the task declares a termination as a time-out; `cause` is the name of its term."""
    term = subject.resolved.task.terminations.get(cause)
    return bool(term.time_out) if term is not None else cause == "time_out"


def repeated_observation(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that computing the observation of a state a second time gives the same values."""
    hint = "compute observations only from the state; advance histories and counters when actions are applied"
    for where, (before, after) in _observe_twice(_env_pair(subject)).items():
        if not equal_values(before, after):
            yield error_at(where, "the observation changes when it is computed a second time in the same state", hint)


def _observe_twice(pair: _EnvPair) -> dict[str, tuple[Tensor, Tensor]]:
    env = pair.kept
    memory = env.observation_manager.state_dict() if isinstance(env, ManagedEnv) else {}
    result = pair.step()[0]
    if isinstance(env, ManagedEnv):
        obs = {group: values.clone() for group, values in result.obs.items()}
        running = ~(result.terminated | result.truncated)
        env.observation_manager.load_state_dict(memory)  # restore histories and filters
        again = env.observation_manager.compute()
        return {f"observations.{group}": (values[running], again[group][running]) for group, values in obs.items()}
    task = task_of(env)
    first = {"obs_buf": task.obs_buf.clone(), "states_buf": task.states_buf.clone()}
    env._fill_buffers()  # type: ignore[attr-defined]
    return {name: (values, getattr(task, name)) for name, values in first.items()}


def observation_after_reset(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that a direct task gives running environments the same observations before and after a reset of others."""
    pair = _env_pair(subject)
    task, observations = task_of(pair.ended), []
    get_observations = task.get_observations

    def recorded() -> object:
        result = get_observations()
        observations.append(task.obs_buf.clone())
        return result

    task.get_observations = recorded  # type: ignore[method-assign]
    result = pair.step()[1]
    done = (result.terminated | result.truncated).tolist()
    # an episode of other environments may end in this step, too
    running = [row for row in range(subject.num_envs) if row not in _ENDING and not done[row]]
    for before, after in pairwise(observations):
        rows = [row for row in running if not equal_values(before[row], after[row])]
        if rows:
            message = f"the observation of running environments {rows} changes when {_ENDING} are reset"
            yield error_at("obs_buf", message, "compute each row only from the state of its environment")
            return

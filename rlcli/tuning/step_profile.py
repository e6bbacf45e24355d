"""Profile of an environment step for `rlcli bench --profile`: the time of each stage of the step, and of each term."""

from __future__ import annotations

import cProfile
import functools
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import CodeType
from typing import Any

import torch

from rlcli.config.load import Resolved
from rlcli.envs.direct import DirectEnv
from rlcli.envs.make import make_env
from rlcli.envs.managed import ManagedEnv
from rlcli.envs.vec_env import VecEnv
from rlcli.managers.term_binding import BoundTerm

_WARM_UP = 32
"""Number of steps before the measurement starts; also the smallest number of measured steps."""
_Stage = tuple[str, list[Callable[..., Any]], list[tuple[str, Callable[..., Any]]]]
"""Stage of the step: name, methods whose time is the stage's time, and its terms as (name, function)."""


@dataclass(frozen=True, slots=True)
class Cost:
    """Time that a part of an environment step takes."""

    section: str
    """Stage of the step, such as `rewards`."""
    term: str | None
    """Name of a term of the stage, or several names (`a, b`) of terms that share a function; None: the whole stage."""
    milliseconds: float
    """Mean time per step of all environments [ms]."""
    share: float
    """Share of the time of the whole step, from 0 to 1."""


def profile_step(resolved: Resolved, seconds: float) -> list[Cost]:
    """Step a task with random actions for some seconds, and return the time of each stage of a step and of each term.

    Each stage is followed by its terms, the slowest first; the last row is the rest of the step. The times come from
    Python's profiler, which makes short functions look slower than they are: compare terms only with each other.

    Args:
        resolved: configuration of the task.
        seconds: duration of the measurement [s].
    """
    env = make_env(resolved, seed=0)
    try:
        env.reset(seed=0)
        actions = torch.rand(16, env.num_envs, env.layout.action_size, device=env.device) * 2.0 - 1.0
        # environments are at different steps of their episodes, as in a long training: some episodes end in most steps
        env.episode_length_buf.copy_(torch.randint(env.max_episode_length, (env.num_envs,), device=env.device))
        _run(env, actions, 0.0)
        profile = cProfile.Profile(builtins=False)
        profile.enable()
        steps = _run(env, actions, seconds)
        profile.disable()
        return _costs(env, {entry.code: entry.totaltime * 1e3 / steps for entry in profile.getstats()})
    finally:
        env.close()


def _run(env: VecEnv, actions: torch.Tensor, seconds: float) -> int:
    """Step the environment for some seconds, and at least `_WARM_UP` times; return the number of steps."""
    end, steps = time.perf_counter() + seconds, 0
    with torch.inference_mode():
        while steps < _WARM_UP or time.perf_counter() < end:
            env.step(actions[steps % len(actions)])
            steps += 1
    return steps


def _costs(env: VecEnv, times: dict[CodeType | str, float]) -> list[Cost]:
    """Return the rows of the profile; `times` has the mean time of each function per step [ms], by its code object."""
    whole = times[type(env).step.__code__]
    costs, stages = [], 0.0
    for section, methods, terms in _stages(env):
        spent = sum(times.get(_code(method), 0.0) for method in methods)
        if spent == 0.0:
            continue
        stages += spent
        costs.append(Cost(section, None, spent, spent / whole))
        named: dict[CodeType, list[str]] = {}
        for name, call in terms:
            named.setdefault(_code(call), []).append(name)
        rows = [(", ".join(names), times[code]) for code, names in named.items() if code in times]
        costs += [Cost(section, name, ms, ms / whole) for name, ms in sorted(rows, key=lambda row: -row[1])]
    return [*costs, Cost("everything else", None, whole - stages, 1.0 - stages / whole)]


def _stages(env: VecEnv) -> Iterator[_Stage]:
    """Yield the stages of a step of the environments, in their order."""
    kind: type[Any] = type(env)
    middle: list[_Stage]
    last: list[_Stage]
    if isinstance(env, ManagedEnv):
        bound = {section: _calls(terms) for section, terms in env._bound.items()}
        bound["observations"] = [
            (f"{group}.{name}", call) for group, terms in env._observations.items() for name, call in _calls(terms)
        ]
        commands, events = env.command_manager, env.event_manager
        updates = [(name, call.update) for name, call in bound["commands"]]
        metrics = [(name, call.metrics) for name, call in bound["commands"]]
        resets = [(term.name, term.call) for term in env._bound["events"] if term.config.mode == "reset"]  # type: ignore[attr-defined]
        intervals = [(term.name, term.call) for term in env._bound["events"] if term.config.mode == "interval"]  # type: ignore[attr-defined]
        middle = [
            ("terminations", [type(env.termination_manager).compute], bound["terminations"]),
            ("rewards", [type(env.reward_manager).compute], bound["rewards"]),
            ("command metrics", [type(commands).measure], metrics),
        ]
        last = [
            ("commands", [type(commands).compute], updates),
            ("interval events", [type(events).interval], intervals),
            ("observations", [type(env.observation_manager).compute], bound["observations"]),
        ]
    else:
        assert isinstance(env, DirectEnv)
        task = type(env.task)
        resets = [("reset", task.reset), ("reset_idx", task.reset_idx)]
        names = ("get_observations", "get_states", "calculate_metrics", "is_done")
        hooks = [(name, getattr(task, name)) for name in names]
        middle = [("rewards, terminations and observations", [kind._compute_rewards_and_dones], hooks)]
        last = [("observations after resets", [kind._compute_observations], [])]
    yield "actions", [kind._apply_action], []
    yield "physics", [VecEnv._simulate], []
    yield "sensors", list({type(sensor).update: None for sensor in env.sensors.values()}), []
    yield from middle
    yield "success", [type(env._counters).count_success], []
    yield "ends of episodes", [VecEnv._end_episodes], []
    yield "resets", [VecEnv._reset_ended], resets
    yield from last


def _calls(terms: list[BoundTerm]) -> list[tuple[str, Any]]:
    """Return (name, function) of each term."""
    return [(term.name, term.call) for term in terms]


def _code(call: Callable[..., Any]) -> CodeType:
    """Return the code object of a callable, by which the profiler identifies it."""
    if isinstance(call, functools.partial):
        return _code(call.func)
    found: CodeType = getattr(call, "__code__", None) or type(call).__call__.__code__
    return found

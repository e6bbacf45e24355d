"""Agents that know nothing, and what a task does under them: the lives that the linter judges."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from rlcli.envs.managed import ManagedEnv
from rlcli.envs.vec_env import VecEnv

Dummy = Callable[[int], Tensor]
"""Step -> action (num_envs, a)."""

SWITCH_S = 0.25
"""How long a bang-bang agent holds a sign, on average [s]."""
SINE_HZ = (0.25, 2.0)
"""Frequencies of the sine agent [Hz]."""


def zero(env: VecEnv, bound: float) -> Dummy:
    """No action."""
    return lambda step: torch.zeros(env.num_envs, env.layout.action_size)


def uniform(env: VecEnv, bound: float) -> Dummy:
    """Uniform within the bound, anew in every step."""
    generator = torch.Generator().manual_seed(0)
    shape = (env.num_envs, env.layout.action_size)
    return lambda step: (torch.rand(shape, generator=generator) * 2.0 - 1.0) * bound


def bang_bang(env: VecEnv, bound: float) -> Dummy:
    """The bound, each column with a sign of its own that it holds for a while."""
    generator = torch.Generator().manual_seed(1)
    shape = (env.num_envs, env.layout.action_size)
    sign = torch.where(torch.rand(shape, generator=generator) < 0.5, -1.0, 1.0)
    switches = min(0.5, env.step_dt / SWITCH_S)

    def act(step: int) -> Tensor:
        sign.mul_(torch.where(torch.rand(shape, generator=generator) < switches, -1.0, 1.0))
        return sign * bound

    return act


def sine(env: VecEnv, bound: float) -> Dummy:
    """Sines as high as the bound, each column of each environment with a frequency and a phase of its own."""
    generator = torch.Generator().manual_seed(2)
    frequency, phase = torch.rand(2, env.num_envs, env.layout.action_size, generator=generator).unbind(0)
    low, high = SINE_HZ
    turn = 2.0 * math.pi * env.step_dt * (low + (high - low) * frequency)
    return lambda step: bound * torch.sin(2.0 * math.pi * phase + turn * step)


DUMMIES: dict[str, Callable[[VecEnv, float], Dummy]] = {
    "zero": zero,
    "random": uniform,
    "bang-bang": bang_bang,
    "sine": sine,
}
"""Name -> agent, in the order in which they live."""


@dataclass(frozen=True, slots=True)
class Episode:
    """One episode, or what there was of it when the watch ended."""

    steps: int
    total: float
    """Undiscounted sum of rewards."""
    terminated: bool
    ended: bool
    causes: tuple[str, ...] = ()


@dataclass(slots=True)
class Life:
    """What a task did under one agent. Tensors are (steps, num_envs, ...)."""

    agent: str
    env: VecEnv
    reward: Tensor
    over: Tensor
    """Whether the episode ended with this step. bool"""
    terminated: Tensor
    terms: dict[str, Tensor]
    """Reward term -> what it paid, weight included; empty for a direct task."""
    obs: dict[str, Tensor]
    """Group -> observations, start states first, divergent ones left out."""
    episodes: list[Episode]
    limited: dict[str, float]
    """What has a limit -> share of the steps in which more was asked than it lets through; of random actions only, as
    an agent at the bound may well mean to reach it."""
    speed: Tensor
    """Root mean square of each velocity. (nv,)"""
    diverged: int
    error: Exception | None = None


@dataclass(slots=True)
class _Notes:
    reward: list[Tensor] = field(default_factory=list)
    over: list[Tensor] = field(default_factory=list)
    terminated: list[Tensor] = field(default_factory=list)
    terms: dict[str, list[Tensor]] = field(default_factory=dict)
    obs: dict[str, list[Tensor]] = field(default_factory=dict)
    limited: dict[str, float] = field(default_factory=dict)
    squares: Tensor | None = None
    looks: int = 0


def live(env: VecEnv, agent: str, bound: float, steps: int) -> Life:
    """Let a dummy agent act from `reset(seed=0)` for some steps, or until something is raised."""
    notes, episodes, error = _Notes(), [], None
    act = DUMMIES[agent](env, bound)
    totals = torch.zeros(env.num_envs)
    env.after_physics = lambda: _look(env, notes, agent == "random")
    try:
        _keep(notes, env.reset(seed=0))
        for step in range(steps):
            action = act(step)
            result = env.step(action)
            notes.reward.append(result.reward.clone())
            notes.over.append(result.terminated | result.truncated)
            notes.terminated.append(result.terminated.clone())
            if isinstance(env, ManagedEnv):
                for name, value in env.reward_manager.values().items():
                    notes.terms.setdefault(name, []).append(value.clone())
            if agent == "random":
                _clipped(env, action, notes)
            _keep(notes, result.obs)
            totals += result.reward
            if result.episodes is not None:
                ended = result.episodes.ended()
                for row, number in enumerate(ended.ids.tolist()):
                    causes = tuple(name for name, mask in ended.causes.items() if bool(mask[row]))
                    length, out = int(ended.lengths[row]), bool(result.terminated[number])
                    episodes.append(Episode(length, float(totals[number]), out, True, causes))
                    totals[number] = 0.0
    except Exception as stopped:
        error = stopped
    finally:
        env.after_physics = None
    running = zip(env.episode_length_buf.tolist(), totals.tolist(), strict=True)
    episodes += [Episode(length, total, False, False) for length, total in running if length]
    looks = max(1, notes.looks)
    return Life(
        agent,
        env,
        _stack(notes.reward, env),
        _stack(notes.over, env),
        _stack(notes.terminated, env),
        {name: torch.stack(values) for name, values in notes.terms.items()},
        {group: torch.stack(values) for group, values in notes.obs.items()},
        episodes,
        {name: count / looks for name, count in notes.limited.items()},
        torch.zeros(0) if notes.squares is None else (notes.squares / looks).sqrt(),
        env.divergences,
        error,
    )


def _stack(steps: list[Tensor], env: VecEnv) -> Tensor:
    return torch.stack(steps) if steps else torch.zeros(0, env.num_envs)


def _keep(notes: _Notes, obs: dict[str, Tensor]) -> None:
    for group, values in obs.items():
        notes.obs.setdefault(group, []).append(values.clone())


def _look(env: VecEnv, notes: _Notes, limits: bool) -> None:
    """Note how fast everything moves and which limits hold efforts and controls back, before anything is reset."""
    notes.looks += 1
    squares = env.engine.field("qvel").double().square().mean(dim=0)
    notes.squares = squares if notes.squares is None else notes.squares + squares
    for entity in env.entities.values() if limits else ():
        if not entity.joint_names:
            continue
        asked, limit = entity.data.computed_effort.abs(), entity.data.joint_effort_limits
        shares = (asked >= limit * (1.0 - 1e-6)).float().mean(dim=0)
        for joint, share in zip(entity.joint_names, shares.tolist(), strict=True):
            _count(notes, f"the effort of joint '{joint}'", share)
    model = env.engine.model
    for number in model.actuator_ctrllimited.nonzero()[0].tolist() if limits else ():
        low, high = model.actuator_ctrlrange[number].tolist()
        slack = 1e-6 * (high - low)
        control = env.engine.field("ctrl")[:, number]
        share = float(((control <= low + slack) | (control >= high - slack)).float().mean())
        _count(notes, f"the control of actuator '{model.actuator(number).name or number}'", share)


def _clipped(env: VecEnv, action: Tensor, notes: _Notes) -> None:
    """Note which columns of the action are clipped before they become commands."""
    column = 0
    for term in env.layout.actions:
        for place in range(term.size):
            clip = None if term.clip is None else term.clip[place]
            if isinstance(clip, tuple):
                scale = 1.0 if term.scale is None else term.scale[place]
                offset = 0.0 if term.offset is None else term.offset[place]
                command = action[:, column + place] * scale + offset
                name = term.elements[place] if len(term.elements) == term.size else str(place)
                share = float(((command < clip[0]) | (command > clip[1])).float().mean())
                _count(notes, f"column {column + place} of the action ({name})", share)
        column += term.size


def _count(notes: _Notes, name: str, share: float) -> None:
    notes.limited[name] = notes.limited.get(name, 0.0) + share

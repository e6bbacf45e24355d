"""Functions for checks that step an environment: test actions, recorded trajectories, ended episodes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from rlcli.envs.step_result import StepResult
from rlcli.envs.vec_env import VecEnv

STEPS = 200
"""Number of steps of a recording."""


@dataclass(slots=True)
class Recording:
    """Step results of an environment, and which of their tensors were changed later."""

    env: VecEnv
    steps: list[StepResult] = field(default_factory=list)
    """The step results themselves, not copies: the task may have changed their tensors in later steps."""
    obs: list[dict[str, Tensor]] = field(default_factory=list)
    """Copies of the observations, beginning with the reset: for each step, group -> (num_envs, d)."""
    late_writes: dict[str, int] = field(default_factory=dict)
    """Name of an output that was changed in place during a later step -> index of the first such step."""
    shared: dict[str, int] = field(default_factory=dict)
    """Name of an output whose tensor shares memory with that of the previous step -> index of the first such step."""
    error: Exception | None = None
    """The error that ended the recording; None: no error."""


@dataclass(frozen=True, slots=True)
class EndedEpisode:
    """Episode that ended in a step."""

    env_id: int
    length: int
    """Number of steps of the episode."""
    terminated: bool
    truncated: bool
    causes: tuple[str, ...]
    """Names of the termination terms that ended the episode."""
    total: float = 0.0
    """Undiscounted sum of the rewards of the episode."""


def ended_episodes(result: StepResult) -> list[EndedEpisode]:
    """Return the episodes that ended in a step; call it before the next step, which overwrites the result."""
    if result.episodes is None:
        return []
    ended = result.episodes.ended()
    episodes = []
    for row, env_id in enumerate(ended.ids.tolist()):
        flags = bool(result.terminated[env_id]), bool(result.truncated[env_id])
        causes = tuple(name for name, fired in ended.causes.items() if bool(fired[row]))
        episodes.append(EndedEpisode(env_id, int(ended.lengths[row]), *flags, causes, float(ended.returns[row])))
    return episodes


def random_actions(env: VecEnv, bound: float, steps: int = STEPS) -> Iterator[Tensor]:
    """Yield actions for `steps` steps, uniform in [-bound, bound], from the environment's seed. (num_envs, a) each"""
    generator = torch.Generator().manual_seed(env.seed)
    for _ in range(steps):
        yield (torch.rand(env.num_envs, env.layout.action_size, generator=generator) * 2.0 - 1.0) * bound


def extreme_actions(env: VecEnv, bound: float) -> Iterator[Tensor]:
    """Yield actions at the bound with alternating signs; every eighth sign is repeated: + - + - + - + - - + - + ...

    Every second environment gets the opposite sign.
    """
    sign = torch.ones(env.num_envs, 1)
    sign[1::2] = -1.0
    for step in range(STEPS):
        action = sign * (-1.0) ** (step + step // 8) * bound
        yield action.expand(-1, env.layout.action_size).clone()


def record(env: VecEnv, actions: Iterator[Tensor]) -> Recording:
    """Reset an environment, and step it until the actions end or an error is raised; return the recorded steps."""
    recording = Recording(env)
    try:
        obs = env.reset(seed=env.seed)
        recording.obs.append(_copy(obs))
        previous = {f"observation '{group}'": value for group, value in obs.items()}
        copies = _copy(previous)
        for number, action in enumerate(actions):
            before = action.clone()
            result = env.step(action)
            recording.steps.append(result)
            recording.obs.append(_copy(result.obs))
            for name, value in previous.items():
                if not equal_values(value, copies[name]):
                    recording.late_writes.setdefault(name, number)
            if not equal_values(action, before):
                recording.late_writes.setdefault("the action", number)
            outputs = step_outputs(result)
            for name, value in outputs.items():
                if name in previous and value.numel() and value.data_ptr() == previous[name].data_ptr():
                    recording.shared.setdefault(name, number)
            previous, copies = outputs, _copy(outputs)
    except Exception as error:
        recording.error = error
    return recording


def record_outputs(env: VecEnv, actions: Iterator[Tensor]) -> list[dict[str, Tensor]]:
    """Return copies of all outputs, by name, of `reset(seed=env.seed)` and of a step with each of the actions."""
    trajectory = [{f"observation '{group}'": value.clone() for group, value in env.reset(seed=env.seed).items()}]
    trajectory += [_copy(step_outputs(env.step(action))) for action in actions]
    return trajectory


def step_outputs(result: StepResult) -> dict[str, Tensor]:
    """Return all tensors of a step result by name."""
    return {
        **{f"observation '{group}'": value for group, value in result.obs.items()},
        "reward": result.reward,
        "terminated": result.terminated,
        "truncated": result.truncated,
    }


def equal_values(left: Tensor, right: Tensor) -> bool:
    """Return whether two tensors have equal values: NaN equals NaN, and 0.0 equals -0.0."""
    return left.shape == right.shape and bool(((left == right) | ((left != left) & (right != right))).all())


def _copy(values: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in values.items()}

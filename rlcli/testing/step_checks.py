"""Checks of `rlcli check` about the results of a task's steps: shapes, types, finite values, actions, aliasing.

Each function tests one rule that a task must keep.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator

import torch
from torch import Tensor

from rlcli.envs.managed import ManagedEnv
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import DivergedError
from rlcli.testing import steps
from rlcli.testing.findings import Finding, error_at
from rlcli.testing.steps import STEPS, record, step_outputs
from rlcli.testing.task_under_test import TaskUnderTest, observation_parts, task_of


def finite(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that observations, final observations and rewards are finite numbers."""
    hint = "look for divisions, square roots and logarithms of values that can be 0, and for buffers that stay empty"
    try:
        recording = subject.recording()
    except DivergedError as error:
        yield error_at(subject.source.label, f"{error.message}; all values must be finite", hint)
        return
    for number, step in enumerate(recording.steps):
        rows = step.terminated | step.truncated
        for group, values in (step.final_obs or {}).items():
            if not bool(values[rows].isfinite().all()):
                message = f"the final observation is not finite at step {number}; all values must be finite"
                yield error_at(f"observations.{group}", message, hint)
                return


def shapes(subject: TaskUnderTest) -> Iterable[Finding]:
    """Check that all tensors have one row for each environment, and the columns that the layout lists."""
    return _check_outputs(subject, _check_shape)


def dtypes(subject: TaskUnderTest) -> Iterable[Finding]:
    """Check that observations and rewards are float32, and terminated and truncated are bool."""
    return _check_outputs(subject, _check_dtype)


def _check_outputs(
    subject: TaskUnderTest, check: Callable[[str, Tensor, tuple[int, ...]], Iterator[Finding]]
) -> list[Finding]:
    """Check the tensors that the task's own code returns; only if they are right, check the result of a step, too.

    A wrong tensor of the task would be reported a second time for the result of the step.

    Args:
        subject: the task.
        check: called with the name of a tensor, the tensor and its expected shape; yields findings.
    """
    recording = subject.recording()
    layout = recording.env.layout
    own = [(name, value, (subject.num_envs, *shape)) for name, value, shape in _task_outputs(recording.env)]
    findings = [finding for output in own for finding in check(*output)]
    if findings or not recording.steps:
        return findings  # a defect of the task's own outputs causes the same defect in the step's outputs
    shapes = {f"observation '{group}'": (subject.num_envs, layout.size(group)) for group in layout.observations}
    outputs = step_outputs(recording.steps[-1])
    return [f for name, value in outputs.items() for f in check(name, value, shapes.get(name, (subject.num_envs,)))]


def _check_shape(name: str, value: Tensor, expected: tuple[int, ...]) -> Iterator[Finding]:
    found = tuple(value.shape)
    if found != expected:
        message = f"the tensor has shape {found}, expected {expected} for {expected[0]} environments"
        hint = "return one row for each environment, and fill buffers in place: buf[:] = ..."
        yield error_at(name, message, hint)


def _check_dtype(name: str, value: Tensor, _: tuple[int, ...]) -> Iterator[Finding]:
    allowed = ["float32"]
    if name == "reset_buf":
        allowed = ["bool", "int64", "int32", "uint8"]
    elif name in ("terminated", "truncated") or name.startswith("terminations."):
        allowed = ["bool"]
    elif name.startswith("rewards."):
        allowed = ["float32", "bool"]
    found = str(value.dtype).removeprefix("torch.")
    if found not in allowed:
        hint = "convert the value with .float(), or compare it for a bool; write into buffers in place: buf[:] = ..."
        yield error_at(name, f"the tensor is {found}, expected {' or '.join(allowed)}", hint)


def _task_outputs(env: VecEnv) -> Iterator[tuple[str, Tensor, tuple[int, ...]]]:
    """Yield the task's own outputs before rlcli casts them: (name, value, shape in one environment)."""
    if not isinstance(env, ManagedEnv):
        task = task_of(env)
        yield "obs_buf", task.obs_buf, (task.num_observations,)
        yield "states_buf", task.states_buf, (task.num_states,)
        yield "rew_buf", task.rew_buf, ()
        yield "reset_buf", task.reset_buf, ()
        return
    manager = env.observation_manager
    for group in manager.groups:
        for pipeline in manager.pipelines(group):
            yield f"observations.{group}.{pipeline.term.name}", pipeline.term.call(), pipeline.shape
    for section, terms in (("rewards", env.reward_manager.terms), ("terminations", env.termination_manager.terms)):
        for term in terms:
            yield f"{section}.{term.name}", term.call(), ()


def random_actions(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that no simulation diverges in 200 steps of random actions within the action bound."""
    recording = subject.recording()
    yield from _check_divergence(subject, recording.env, len(recording.steps))


def extreme_actions(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that no simulation diverges in 200 steps of actions at the bound with alternating signs."""
    env = subject.env()
    recording = record(env, steps.extreme_actions(env, subject.bound))
    yield from _check_divergence(subject, env, len(recording.steps))
    if recording.error is not None:
        raise recording.error


def _check_divergence(subject: TaskUnderTest, env: VecEnv, steps: int) -> Iterator[Finding]:
    if env.divergences:
        where = f"sim.dt = {env.physics_dt:g} s, {steps} of {STEPS} steps"
        message = f"the simulation diverged with actions within +-{subject.bound:g} (divergences: {env.divergences})"
        hint = "take a smaller sim.dt, more damping or armature, lower gains, or an effort_limit"
        yield error_at(where, f"{message}; it must never diverge", hint)


def constant_columns(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that every observation column varies between environments or steps; of an image, at least one pixel."""
    recording = subject.recording()
    for group in recording.env.layout.observations:
        fixed = _fixed_command_columns(recording.env, group)
        obs = torch.stack([obs[group] for obs in recording.obs])
        for where, columns in observation_parts(recording.env, group):
            values = obs[:, :, columns]
            if bool((values == values[0, 0]).all()) and where not in fixed:
                value = f"the column is {float(values[0, 0]):g}" if values.shape[2] == 1 else "every pixel is the same"
                message = f"{value} in {subject.num_envs} environments and {len(obs)} observations"
                hint = "compute the column from the state, or leave it out: a policy cannot learn from it"
                yield error_at(where, message, hint)


def _fixed_command_columns(env: VecEnv, group: str) -> set[str]:
    """Return the observation columns of a command whose range is a single number [x, x].

    Such a column is constant on purpose. The names are those of `observation_parts`.
    """
    found: set[str] = set()
    if not isinstance(env, ManagedEnv):
        return found
    parts = iter(observation_parts(env, group))
    for pipeline in env.observation_manager.pipelines(group):
        config = pipeline.term.config
        names = [name for name, _ in itertools.islice(parts, pipeline.size if len(pipeline.shape) == 1 else 1)]
        if config.func != "generated_commands":
            continue
        command = env.command_manager.get_term(config.params["command"])
        limits = list(getattr(command, "limits", ()))
        columns = config.params.get("columns") or range(command.command.shape[1])
        is_fixed = [column < len(limits) and limits[column][0] == limits[column][1] for column in columns]
        found |= {name for name, fixed in zip(names, is_fixed * pipeline.history, strict=True) if fixed}
    return found


def aliasing(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that the outputs of a step are not changed during the next step, and that actions are not changed."""
    recording = subject.recording()
    for name, step in recording.late_writes.items():
        message = f"the tensor was changed in place at step {step}, while a trainer still uses it"
        yield error_at(name, message, "write to a tensor that the task owns, or clone() the tensor first")
    for name, step in recording.shared.items():
        if name not in recording.late_writes:
            message = f"the tensor of step {step} shares its memory with the tensor of the step before"
            yield error_at(name, message, "return a new tensor instead of a buffer that the term reuses")

"""Checks of names, files and step results. One function for each clause of the contract."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import torch
from torch import Tensor

from rlcli.config.dump import to_data, to_yaml
from rlcli.config.load import resolve
from rlcli.envs.managed import ManagedEnv
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import ConfigError, DivergedError, listing
from rlcli.registry import model_file
from rlcli.scene.untrusted_mjcf import model_roots, read_mjcf
from rlcli.testing.task_under_test import (
    NUM_ENVS,
    STEPS,
    Finding,
    TaskUnderTest,
    error_at,
    extreme_actions,
    observation_parts,
    record,
    step_outputs,
    task_of,
    warning_at,
)


def names(subject: TaskUnderTest) -> Iterator[Finding]:
    """Every name in the YAML resolves; joints, actuators and bodies of the models have names."""
    for entity, config in subject.resolved.task.scene.entities.items():
        if config.model is None:
            continue  # a shape has the names that rlcli gives it
        root = subject.source.root
        spec = read_mjcf(model_file(root, config.model), model_roots(root, config.model))
        scalar = [joint for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE]  # a root needs no name
        for word, elements in (("joint", scalar), ("actuator", list(spec.actuators)), ("body", spec.bodies[1:])):
            unnamed = [element for element in elements if not element.name]
            if unnamed:
                places = [f"on '{e.target}'" if word == "actuator" else f"in '{e.parent.name}'" for e in unnamed]
                yield warning_at(
                    f"scene.entities.{entity}: {config.model}",
                    f"{word} without a name: {listing(places)}; a term can reach it only by its place in the file",
                    f'name it in the MJCF: <{word} name="..."/>',
                )


def yaml_round_trip(subject: TaskUnderTest) -> Iterator[Finding]:
    """The resolved configuration, written as YAML and read again, is the same configuration."""
    data = to_data(subject.resolved)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "config.yaml"
        file.write_text(to_yaml(data), encoding="utf-8")
        try:
            again = to_data(resolve(replace(subject.source, config=file)))
        except ConfigError as error:
            for problem in error.problems:
                yield error_at(
                    problem.path or subject.source.label,
                    f"does not read back from YAML: {problem.message}",
                    problem.hint or "use a value that YAML has (finite numbers, text, lists)",
                )
            return
    for path, was, now in _differences(data, again):
        yield error_at(
            path,
            f"is {was!r}, and {now!r} after writing and reading the configuration",
            "a run keeps its configuration as YAML: use a value that YAML can hold",
        )


def _differences(was: object, now: object, path: str = "") -> Iterator[tuple[str, object, object]]:
    if isinstance(was, dict) and isinstance(now, dict):
        for key in {**was, **now}:
            yield from _differences(was.get(key), now.get(key), f"{path}.{key}" if path else str(key))
    elif was != now and not (isinstance(was, list | tuple) and list(was) == now):
        yield path, was, now


# --- what a step gives ---


def finite(subject: TaskUnderTest) -> Iterator[Finding]:
    """Observations, final observations and rewards are finite numbers."""
    where = subject.source.label
    hint = "look for divisions, square roots and logarithms of what can be 0, and for buffers that are never filled"
    try:
        recording = subject.recording()
    except DivergedError as error:
        yield error_at(where, f"{error.message}; allowed are finite numbers", hint)
        return
    final = [v for step in recording.steps for v in (step.final_obs or {}).values()]
    for number, step in enumerate(recording.steps):
        rows = step.terminated | step.truncated
        for group, values in (step.final_obs or {}).items():
            if final and not bool(values[rows].isfinite().all()):
                message = f"the final observation is not finite at step {number}; allowed are finite numbers"
                yield error_at(f"observations.{group}", message, hint)
                return


def shapes(subject: TaskUnderTest) -> Iterator[Finding]:
    """Everything has the shape that the layout and the number of environments promise."""
    recording = subject.recording()
    env = recording.env
    own = [finding for what, value, own_shape in _raw(env) for finding in _shape(what, value, (NUM_ENVS, *own_shape))]
    yield from own
    if own:
        return  # what the framework makes of it follows from that
    expected = {f"observation '{group}'": (NUM_ENVS, env.layout.size(group)) for group in env.layout.observations}
    for step in recording.steps[-1:]:
        for what, value in step_outputs(step).items():
            yield from _shape(what, value, expected.get(what, (NUM_ENVS,)))


def _shape(what: str, value: Tensor, expected: tuple[int, ...]) -> Iterator[Finding]:
    found = tuple(value.shape)
    if found != expected:
        message = f"has shape {found}, expected {expected} for {NUM_ENVS} environments"
        hint = "return one row an environment, and fill buffers in place: buf[:] = ..."
        yield error_at(what, message, hint)


def dtypes(subject: TaskUnderTest) -> Iterator[Finding]:
    """Observations and rewards are float32, terminated and truncated are bool."""
    recording = subject.recording()
    own = [finding for what, value, _ in _raw(recording.env) for finding in _dtype(what, value, _allowed(what))]
    yield from own
    if own:
        return
    for step in recording.steps[-1:]:
        for what, value in step_outputs(step).items():
            yield from _dtype(what, value, _FLAG if what in ("terminated", "truncated") else (torch.float32,))


_FLAG = (torch.bool,)


def _allowed(what: str) -> tuple[torch.dtype, ...]:
    if what == "reset_buf":
        return (torch.bool, torch.int64, torch.int32, torch.uint8)
    if what.startswith("terminations."):
        return _FLAG
    return (torch.float32, torch.bool) if what.startswith("rewards.") else (torch.float32,)


def _dtype(what: str, value: Tensor, allowed: tuple[torch.dtype, ...]) -> Iterator[Finding]:
    if value.dtype not in allowed:
        message = f"is {_name(value.dtype)}, expected {' or '.join(map(_name, allowed))}"
        hint = "end a term with .float() or a comparison; fill buffers in place: buf[:] = ..."
        yield error_at(what, message, hint)


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _raw(env: VecEnv) -> Iterator[tuple[str, Tensor, tuple[int, ...]]]:
    """What the task itself gives, before the framework casts it: (name, value, its shape in one environment)."""
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


def random_actions_stay_stable(subject: TaskUnderTest) -> Iterator[Finding]:
    """200 steps of random actions within the action bound, and no simulation diverges."""
    recording = subject.recording()
    yield from _stable(subject, recording.env, len(recording.steps))


def extreme_actions_stay_stable(subject: TaskUnderTest) -> Iterator[Finding]:
    """200 steps of actions at the bound, signs alternating, and no simulation diverges."""
    env = subject.env()
    recording = record(env, extreme_actions(env, subject.bound))
    yield from _stable(subject, env, len(recording.steps))
    if recording.error is not None:
        raise recording.error


def _stable(subject: TaskUnderTest, env: VecEnv, steps: int) -> Iterator[Finding]:
    if env.divergences:
        yield error_at(
            f"sim.dt = {env.physics_dt:g} s, {steps} of {STEPS} steps",
            f"the simulation diverged {env.divergences} times with actions within +-{subject.bound:g}; it must never",
            "take a smaller sim.dt, more damping or armature, lower gains, or an effort_limit",
        )


def constant_columns(subject: TaskUnderTest) -> Iterator[Finding]:
    """No observation column keeps one value in all environments and steps; of a picture, some pixel does not."""
    recording = subject.recording()
    for group in recording.env.layout.observations:
        seen = torch.stack([obs[group] for obs in recording.obs])
        for where, columns in observation_parts(recording.env, group):
            values = seen[:, :, columns]
            if bool((values == values[0, 0]).all()):
                what = f"is {float(values[0, 0]):g}" if values.shape[2] == 1 else "is the same"
                yield error_at(
                    where,
                    f"{what} in {NUM_ENVS} environments and {len(seen)} observations",
                    "a policy cannot learn from it: compute it from the state, or leave it out",
                )


def aliasing(subject: TaskUnderTest) -> Iterator[Finding]:
    """What a step gave keeps its values while the next step runs, and actions are not written to."""
    recording = subject.recording()
    for what, step in recording.late_writes.items():
        yield error_at(
            what,
            f"was changed in place at step {step}; a trainer keeps it",
            "write into a tensor of your own, or clone() first",
        )
    for what, step in recording.shared.items():
        if what not in recording.late_writes:
            yield error_at(
                what,
                f"shares its memory with the one before, at step {step}",
                "return a new tensor instead of a buffer that the term keeps",
            )

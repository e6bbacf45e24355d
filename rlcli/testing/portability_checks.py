"""Checks of portability: threads, number of environments, engines, checkpoints, versions and speed."""

from __future__ import annotations

import json
import random
import sys
import time
from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rlcli.config.load import resolve
from rlcli.envs.direct import DirectEnv, DirectTask
from rlcli.envs.make import make_env
from rlcli.envs.managed import ManagedEnv
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import ConfigError, DeviceError, RlcliError
from rlcli.runs.bundle import open_bundle
from rlcli.runs.restore import require_fit
from rlcli.testing.episode_checks import first_difference
from rlcli.testing.host_sync import HostSyncError, HostSyncGuard
from rlcli.testing.task_under_test import (
    NUM_ENVS,
    Finding,
    NotRunError,
    TaskUnderTest,
    error_at,
    random_actions,
    record_trajectory,
    step_outputs,
    task_of,
    warning_at,
)

STEPS = 16
EPISODE = 12
"""Steps of an episode, so that some end on the way."""


def threads(subject: TaskUnderTest) -> Iterator[Finding]:
    """The engine's threads change nothing, bit for bit."""
    trajectories = []
    for count in (1, 3):
        env = subject.env(episode_steps=EPISODE, flags={"sim.engine_threads": count})
        torch.manual_seed(0)
        trajectories.append(record_trajectory(env, random_actions(env, subject.bound, STEPS)))
    difference = first_difference(env, *trajectories)
    if difference is not None:
        where, message = difference
        hint = "let nothing depend on engine_threads or on the number of cores"
        yield error_at(where, f"differs between 1 and 3 engine threads: {message}", hint)


FEW = 3


def num_envs(subject: TaskUnderTest) -> Iterator[Finding]:
    """An environment lives the same life however many others there are, bit for bit."""
    many = subject.env(episode_steps=EPISODE)
    few = subject.env(episode_steps=EPISODE, flags={"scene.num_envs": FEW})
    actions = list(random_actions(many, subject.bound, STEPS))
    torch.manual_seed(0)
    seeded = _random_states()
    trajectories = [record_trajectory(many, (a.clone() for a in actions))]
    drew = _random_states() != seeded
    torch.manual_seed(0)
    trajectories.append(record_trajectory(few, (a[:FEW].clone() for a in actions)))
    difference = first_difference(
        many, [{n: v[:FEW] for n, v in step.items()} for step in trajectories[0]], trajectories[1]
    )
    if difference is None:
        return
    where, message = difference
    message = f"differs between {NUM_ENVS} and {FEW} environments: {message}"
    if drew:
        message += "; the task draws from torch, numpy or random, which know nothing of environments"
        hint = "with the selection's draws, or self.draws(env_ids), it would not; without, runs of other sizes differ"
    elif subject.resolved.task.curriculum:
        message += "; a curriculum that averages over episodes may mean it so"
        hint = "let a schedule go by steps, if it should not depend on the number of environments"
    else:
        hint = (
            "compute each row from its own environment alone; torch's sum over dim 0, atan2 and pow round differently"
        )
        hint += " for other sizes (rlcli.sim.rotations has an atan2 that does not)"
        yield error_at(where, message, hint)
        return
    yield warning_at(where, message, hint)


def _random_states() -> tuple[Any, ...]:
    """Where the generators stand that are not rlcli's."""
    numpy: Any = np.random.get_state()
    return torch.get_rng_state().numpy().tobytes(), numpy[1].tobytes(), numpy[2:], random.getstate()


# --- stopped and resumed, in versions ---


def checkpoint(subject: TaskUnderTest) -> Iterator[Finding]:
    """Saved in mid-run and restored elsewhere, a life goes on bit for bit: terms, commands and curriculum included."""
    env, other = subject.env(episode_steps=EPISODE), subject.env(episode_steps=EPISODE, seed=1)
    actions = list(random_actions(env, subject.bound, 7 + STEPS))
    other.reset(seed=1)
    for action in actions[-3:]:
        other.step(action.clone())
    env.reset(seed=0)
    result = None
    for action in actions[:7]:
        result = env.step(action.clone())
    assert result is not None
    saved = env.state_dict()
    last = {f"observation '{group}'": values.clone() for group, values in result.obs.items()}
    again = {f"observation '{group}'": values.clone() for group, values in other.load_state_dict(saved).items()}
    trajectories = [[last, *_continue(env, actions[7:])], [again, *_continue(other, actions[7:])]]
    difference = first_difference(env, *trajectories)
    if difference is not None:
        where, message = difference
        kept = "keep what is carried on in tensors, numbers, containers or random generators, as attributes"
        hint = f"{kept}; a term may have state_dict() and load_state_dict(state) of its own"
        if not isinstance(env, ManagedEnv):
            hint = f"{kept} of the task"
        if unsaved := env.unsaved_state():
            hint = f"no checkpoint can hold {', '.join(unsaved)}; {hint}"
        message = f"goes on differently after saving and restoring: {message}"
        yield error_at(where, message, f"{hint}; else a resumed run is another run")


def _continue(env: VecEnv, actions: list[Tensor]) -> list[dict[str, Tensor]]:
    torch.manual_seed(0)
    return [{n: v.clone() for n, v in step_outputs(env.step(action.clone())).items()} for action in actions]


def policy(subject: TaskUnderTest) -> Iterator[Finding]:
    """The policy that is shipped with the task can be read, and fits the task as it is."""
    folder = subject.source.policy
    if folder is None:
        raise NotRunError("the task ships none; rlcli export --format bundle writes one")
    try:
        bundle = open_bundle(folder)
        bundle.policy()
        one = resolve(subject.source, agent=bundle.manifest.get("agent"), play=True, flags={"scene.num_envs": 1})
        env = make_env(one)
        require_fit(bundle, env.layout)
        env.close()
    except RlcliError as error:
        hint = "train again, and export the new policy as a bundle to the same folder"
        yield error_at(str(folder), error.message, hint)
        return
    name = bundle.manifest["task"]["name"]
    if name != subject.source.name:
        message = f"is a policy for '{name}'"
        yield error_at(str(folder), message, f"export one of {subject.source.name}")


def layout_file(subject: TaskUnderTest) -> Path:
    """Where the layout of a task is recorded: beside its configuration."""
    config = subject.source.config
    return config.with_name(f"{config.stem}.layout.json")


def record_layout(subject: TaskUnderTest) -> Path:
    """Write down which columns the task's observations and actions have now."""
    record = subject.env().layout.record()
    file = layout_file(subject)
    kept = {part: record[part] for part in ("observations", "actions")}
    file.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
    return file


def layout(subject: TaskUnderTest) -> Iterator[Finding]:
    """Observations and actions are those that were recorded, in the same order, where that was done."""
    file = layout_file(subject)
    if not file.is_file():
        raise NotRunError(f"there is no {file.name}; `rlcli check TASK --record-layout` writes it")
    hint = (
        f"put it back, or take it for good with --record-layout: what was trained before no longer fits ({file.name})"
    )
    try:
        before = json.loads(file.read_text(encoding="utf-8"))
        then = {**{f"observations.{g}": t for g, t in before["observations"].items()}, "actions": before["actions"]}
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        yield error_at(file.name, f"is no recorded layout: {error!r}", "write it anew: --record-layout")
        return
    record = json.loads(json.dumps(subject.env().layout.record()))
    now = {**{f"observations.{g}": t for g, t in record["observations"].items()}, "actions": record["actions"]}
    for where in {**then, **now}:
        difference = _changed(then.get(where), now.get(where))
        if difference is not None:
            yield error_at(where, difference, hint)


def _changed(then: list[dict[str, Any]] | None, now: list[dict[str, Any]] | None) -> str | None:
    """The first difference between two lists of terms."""
    if then is None or now is None:
        return "is new" if then is None else "is gone"
    before, after = list(_columns(then)), list(_columns(now))
    first = next((n for n, (old, new) in enumerate(zip(before, after, strict=False)) if old != new), None)
    if len(before) != len(after):
        at = min(len(before), len(after)) if first is None else first
        return f"had {len(before)} columns and has {len(after)}, other ones from column {at} on"
    if first is not None:
        return f"column {first} was '{before[first]}' and is '{after[first]}'"
    for old_term, new_term in zip(then, now, strict=True):
        for key in {**old_term, **new_term}:
            if old_term.get(key) != new_term.get(key):
                return f"'{new_term['name']}': {key} was {old_term.get(key)} and is {new_term.get(key)}"
    return None


def _columns(terms: list[dict[str, Any]]) -> Iterator[str]:
    for term in terms:
        elements = term["elements"] if len(term["elements"]) == term["size"] else range(term["size"])
        for element in elements:
            yield f"{term['name']}[{element}]"


# --- how fast ---

SMALL, LARGE = 16, 256


def speed(subject: TaskUnderTest) -> Iterator[Finding]:
    """No Python loop runs over environments: how many lines a step and a reset run does not grow with them."""
    lines, seconds = [], []
    for count in (SMALL, LARGE):
        env = subject.env(flags={"scene.num_envs": count})
        action = torch.zeros(count, env.layout.action_size)
        env.reset(seed=0)
        env.step(action.clone())
        env.step(action.clone())  # by then what is made late is made
        start = time.perf_counter()
        for _ in range(10):
            env.step(action.clone())
        seconds.append((time.perf_counter() - start) / 10)
        lines.append(_lines(env, action))
    rate = LARGE / seconds[1]
    subject.notes["speed"] = f"{rate:,.0f} steps/s with {LARGE} environments on one engine thread"
    grown = lines[1] - lines[0]
    loops = {place: count for place, count in grown.items() if count >= (LARGE - SMALL) // 2}
    if not loops:
        return
    own = {p: c for p, c in loops.items() if Path(p[0]).is_relative_to(subject.source.root)}
    (file, line), _ = max((own or loops).items(), key=lambda item: item[1])
    yield warning_at(
        f"{file}:{line}",
        f"runs {lines[0][file, line]} times with {SMALL} environments and {lines[1][file, line]} times with {LARGE}:"
        f" a Python loop over environments; a step takes {seconds[0] * 1e3:.1f} and {seconds[1] * 1e3:.1f} ms"
        f" ({rate:,.0f} steps/s)",
        "compute all rows at once: tensor[:, column], torch.where, selection.write",
    )


def _lines(env: VecEnv, action: Tensor) -> Counter[tuple[str, int]]:
    """How often each line of Python runs in a step and a reset. Times would depend on who else uses the machine."""
    counts: Counter[tuple[str, int]] = Counter()

    def count(frame: FrameType, event: str, value: object) -> Any:
        counts[frame.f_code.co_filename, frame.f_lineno] += 1
        return count

    before = sys.gettrace()
    sys.settrace(count)
    try:
        env.step(action)
        env.reset(seed=0)
    finally:
        sys.settrace(before)
    return counts


# --- the other engine ---

FEW_WORLDS = 2
CLOSE = 1e-3


def engines(subject: TaskUnderTest) -> Iterator[Finding]:
    """The task runs on the GPU's engine too, and starts and steps there as on the CPU's, but for rounding."""
    other = _warp(subject)
    env = subject.env(episode_steps=EPISODE, flags={"scene.num_envs": FEW_WORLDS})
    place = "sim.engine = warp"
    hint = "use the selection's methods and the engine's fields alone; or say sim.engine: batch, if it is for CPUs only"
    action = next(random_actions(env, subject.bound))
    seen = []
    for one in (env, other):
        torch.manual_seed(0)  # what a task draws from torch itself is same-seed's business
        seen.append((one.reset(seed=0), step_outputs(one.step(action.clone()))))
    other.check()
    pairs = list(zip(*seen, strict=True))
    for when, (left, right) in zip(("at the start", "after a step"), pairs, strict=True):
        for what, values in left.items():
            there = right[what].to(values.device)
            if values.shape != there.shape or values.dtype != there.dtype:
                message = f"{what} is {tuple(values.shape)} {values.dtype} on the CPU's engine and"
                message += f" {tuple(there.shape)} {there.dtype} on the GPU's, {when}"
                yield error_at(place, message, hint)
                return
            far = (values.float() - there.float()).abs() > CLOSE * (1.0 + values.float().abs())
            if bool(far.any()):
                index = tuple(far.nonzero()[0].tolist())
                message = (
                    f"{what} is {float(values[index]):.5g} on the CPU's engine and {float(there[index]):.5g} on the"
                )
                message += f" GPU's in environment {index[0]}, {when}"
                yield warning_at(place, message, hint)
                return


def captured(subject: TaskUnderTest) -> Iterator[Finding]:
    """A step on a GPU asks the host for nothing, so that it can be recorded once and replayed."""
    if subject.is_direct:
        env = subject.recording().env
        if isinstance(env, DirectEnv) and env.not_recorded is not None:
            raise NotRunError(env.not_recorded)
        if type(task_of(env)).reset_idx is not DirectTask.reset_idx:
            raise NotRunError("reset_idx takes ids, so a GPU runs it as it is; `reset(selection)` could be recorded")
    env = _warp(subject)
    action = torch.zeros(FEW_WORLDS, env.layout.action_size)
    env.reset(seed=0)
    env.step(action)
    try:
        with HostSyncGuard():  # type: ignore[no-untyped-call]  # torch has no type here
            for _ in range(EPISODE + 1):
                env.step(action)
    except HostSyncError as error:
        hint = "compute with torch.where and masks over all rows: docs/tutorials/train-on-a-gpu.md; else it runs several times slower there"
        yield warning_at(subject.place(error), f"{error}, in a step", hint)


def _warp(subject: TaskUnderTest) -> VecEnv:
    """A few worlds on MuJoCo Warp's CPU device.

    Raises:
        NotRunError: where there is none, or it cannot run this model.
    """
    if subject.resolved.task.sim.engine == "batch":
        raise NotRunError("the task says sim.engine: batch")
    if find_spec("mujoco_warp") is None:
        raise NotRunError('MuJoCo Warp is not installed; pip install "rlcli[gpu]"')
    try:
        return subject.env(episode_steps=EPISODE, flags={"scene.num_envs": FEW_WORLDS, "sim.engine": "warp"})
    except (ConfigError, DeviceError) as error:
        raise NotRunError(f"MuJoCo Warp does not take it: {' '.join(error.message.split())}") from None

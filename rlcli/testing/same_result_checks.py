"""Checks of `rlcli check` that compare two trajectories of a task, and checks of its files and its speed.

The trajectories must be equal with other numbers of threads and of environments, on the GPU engine, and after a restore
from a checkpoint. Further checks: the shipped policy fits the task, observation and action columns are as recorded in
the task's file, and no Python loop runs over environments.
"""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from torch import Tensor

from rlcli.config.load import resolve
from rlcli.envs.direct import DirectEnv, DirectTask
from rlcli.envs.make import make_env
from rlcli.envs.managed import ManagedEnv
from rlcli.envs.vec_env import VecEnv
from rlcli.errors import ConfigError, DeviceError, RlcliError, pip_install
from rlcli.machine.plain_files import read_plain
from rlcli.rl.rng import rng_state
from rlcli.runs.checkpoint_fit import require_fit
from rlcli.runs.policy_bundle import open_bundle
from rlcli.runs.safe_io import JSON_LIMIT
from rlcli.testing.episode_checks import compare_trajectories
from rlcli.testing.findings import Finding, NotRunError, error_at, warning_at
from rlcli.testing.host_sync import HostSyncError, HostSyncGuard
from rlcli.testing.steps import equal_values, random_actions, record_outputs, step_outputs
from rlcli.testing.task_under_test import TaskUnderTest, element_names, task_of

STEPS = 16
"""Number of steps of a compared trajectory."""
EPISODE = 12
"""Length of an episode in these checks [steps]; it is below `STEPS`, so that episodes end within a trajectory."""


def threads(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that trajectories are bit-identical with any number of engine threads."""
    trajectories = []
    for count in (1, 3):
        env = subject.env(episode_steps=EPISODE, flags={"sim.engine_threads": count})
        torch.manual_seed(0)
        trajectories.append(record_outputs(env, random_actions(env, subject.bound, STEPS)))
    hint = "remove everything that depends on engine_threads or on the number of cores"
    yield from compare_trajectories(
        env, trajectories, "this output of the step differs between 1 and 3 engine threads", hint
    )


FEW = 3
"""Smaller one of two numbers of environments whose trajectories are compared."""


def num_envs(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that the trajectory of an environment is bit-identical with any number of environments."""
    many = subject.env(episode_steps=EPISODE)
    few = subject.env(episode_steps=EPISODE, flags={"scene.num_envs": FEW})
    actions = list(random_actions(many, subject.bound, STEPS))
    torch.manual_seed(0)
    before = rng_state()
    of_many = [{n: v[:FEW] for n, v in step.items()} for step in record_outputs(many, (a.clone() for a in actions))]
    draws_globally = any(not equal_values(state, before[name]) for name, state in rng_state().items())
    torch.manual_seed(0)
    of_few = record_outputs(few, (a[:FEW].clone() for a in actions))
    make, reason = warning_at, ""
    if draws_globally:
        reason = "; the task draws from torch, numpy or random, whose numbers depend on the number of environments"
        hint = "sample with selection.uniform or self.draws(env_ids); otherwise results depend on num_envs"
    elif subject.resolved.task.curriculum:
        reason = "; this may be intended for a curriculum that averages over episodes"
        hint = "use a schedule over steps, if the curriculum should not depend on the number of environments"
    else:
        make = error_at
        hint = "compute each row only from its environment; torch's sum over dim 0, atan2 and pow round differently for"
        hint += " other sizes (rlcli.sim.rotations has an atan2 that does not)"
    message = f"this output of the step differs between {subject.num_envs} and {FEW} environments{reason}"
    yield from compare_trajectories(many, (of_many, of_few), message, hint, make)


# --- checkpoints and versions ---


def checkpoint(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that a restored environment continues bit-identically: terms, commands and curriculum included."""
    env, other = subject.env(episode_steps=EPISODE), subject.env(episode_steps=EPISODE)
    actions = list(random_actions(env, subject.bound, 7 + STEPS))
    env.reset(seed=env.seed)
    for action in actions[:7]:
        result = env.step(action.clone())
    saved = env.state_dict()
    last = {f"observation '{group}'": values.clone() for group, values in result.obs.items()}
    original = [last, *_continue(env, actions[7:])]
    hint = "store state in tensors, numbers, containers or random generators, as attributes"
    if isinstance(env, ManagedEnv):
        hint += "; a term may define state_dict() and load_state_dict(state)"
    else:
        hint += " of the task"
    if unsaved := env.unsaved_state():
        hint = f"no checkpoint can hold {', '.join(unsaved)}; {hint}"
    hint += "; else a resumed run differs from a run without interruption"
    message = "this output of the step differs after saving and restoring"
    for steps in (0, 3):  # a state that is not saved may by chance be right before any step, or after some
        other.reset(seed=subject.seed + 1)
        for action in actions[:steps]:
            other.step(action.clone())
        again = {f"observation '{group}'": values.clone() for group, values in other.load_state_dict(saved).items()}
        found = list(compare_trajectories(env, [original, [again, *_continue(other, actions[7:])]], message, hint))
        yield from found
        if found:
            return


def _continue(env: VecEnv, actions: list[Tensor]) -> list[dict[str, Tensor]]:
    torch.manual_seed(0)
    return [{n: v.clone() for n, v in step_outputs(env.step(action.clone())).items()} for action in actions]


def policy(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that the policy that the task ships can be read, and fits the task."""
    folder = subject.source.policy
    if folder is None:
        raise NotRunError("the task ships no policy; `rlcli export --format bundle` writes a policy to ship")
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
        message = f"the folder has a policy for '{name}'"
        yield error_at(str(folder), message, f"export a policy for {subject.source.name}")


def layout_file(subject: TaskUnderTest) -> Path:
    """Return the file in which the layout of a task is recorded, beside its configuration."""
    config = subject.source.config
    return config.with_name(f"{config.stem}.layout.json")


def layout(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that observations and actions have the recorded columns in the recorded order, if they were recorded."""
    file = layout_file(subject)
    if not file.is_file():
        raise NotRunError(f"there is no {file.name}; `rlcli check TASK --record-layout` writes it")
    hint = "undo the change; or record the new columns with `rlcli check TASK --record-layout`: policies that were"
    hint += f" trained with the columns in {file.name} then no longer fit"
    try:
        recorded = _groups(json.loads(read_plain(file, JSON_LIMIT)))
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        yield error_at(
            file.name,
            f"the file has no record of the columns: {error!r}",
            "write the file again: rlcli check TASK --record-layout",
        )
        return
    current = _groups(json.loads(json.dumps(subject.env().layout.record())))
    for where in {**recorded, **current}:
        difference = _changed(recorded.get(where), current.get(where))
        if difference is not None:
            yield error_at(where, difference, hint)


def _groups(record: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    return {**{f"observations.{g}": terms for g, terms in record["observations"].items()}, "actions": record["actions"]}


def _changed(then: list[dict[str, Any]] | None, now: list[dict[str, Any]] | None) -> str | None:
    """Return the first difference between the recorded and the present terms as text; None if they are equal."""
    if then is None or now is None:
        return "this group is new" if then is None else "this group does not exist any more"
    before, after = _columns(then), _columns(now)
    first = next((n for n, (old, new) in enumerate(zip(before, after, strict=False)) if old != new), None)
    if len(before) != len(after):
        at = min(len(before), len(after)) if first is None else first
        return f"the group had {len(before)} columns and has {len(after)}; the first difference is column {at}"
    if first is not None:
        return f"column {first} was '{before[first]}' and is '{after[first]}'"
    for old_term, new_term in zip(then, now, strict=True):
        for key in {**old_term, **new_term}:
            if old_term.get(key) != new_term.get(key):
                return f"'{new_term['name']}': {key} was {old_term.get(key)} and is {new_term.get(key)}"
    return None


def _columns(terms: list[dict[str, Any]]) -> list[str]:
    return [f"{term['name']}[{e}]" for term in terms for e in element_names(term["elements"], term["size"])]


# --- speed ---

SMALL, LARGE = 16, 256
"""Numbers of environments whose executed lines of Python are compared."""


def speed(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that no Python loop runs over environments: more environments must not execute more lines of code."""
    lines, seconds = [], []
    for count in (SMALL, LARGE):
        env = subject.env(flags={"scene.num_envs": count})
        action = torch.zeros(count, env.layout.action_size)
        env.reset(seed=env.seed)
        env.step(action.clone())
        env.step(action.clone())  # the first two steps create everything that is created lazily
        start, steps = time.perf_counter(), 0
        while steps < 10 and time.perf_counter() < start + 1.0:  # a step of a large model can take a second
            env.step(action.clone())
            steps += 1
        seconds.append((time.perf_counter() - start) / steps)
        lines.append(_count_lines(env, action))
    rate = LARGE / seconds[1]
    subject.notes["speed"] = f"{rate:,.0f} steps/s with {LARGE} environments on one engine thread"
    grown = lines[1] - lines[0]
    loops = {line: count for line, count in grown.items() if count >= (LARGE - SMALL) // 2}
    if not loops:
        return
    own = {p: c for p, c in loops.items() if Path(p[0]).is_relative_to(subject.source.root)}
    (file, line), _ = max((own or loops).items(), key=lambda item: item[1])
    yield warning_at(
        f"{file}:{line}",
        f"the line runs {lines[0][file, line]} times with {SMALL} environments and {lines[1][file, line]} times with"
        f" {LARGE}: a Python loop over environments; a step takes {seconds[0] * 1e3:.1f} and {seconds[1] * 1e3:.1f} ms"
        f" ({rate:,.0f} steps/s)",
        "compute all rows at once: tensor[:, column], torch.where, selection.write",
    )


def _count_lines(env: VecEnv, action: Tensor) -> Counter[tuple[str, int]]:
    """Return (file, line) -> how often the line runs in a step and a reset. Unlike times, counts are reproducible."""
    counts: Counter[tuple[str, int]] = Counter()

    def count(frame: FrameType, event: str, value: object) -> Any:
        counts[frame.f_code.co_filename, frame.f_lineno] += 1
        return count

    before = sys.gettrace()
    sys.settrace(count)
    try:
        env.step(action)
        env.reset(seed=env.seed)
    finally:
        sys.settrace(before)
    return counts


# --- the GPU engine ---

FEW_WORLDS = 2
"""Number of environments on the GPU engine; it is small, because MuJoCo Warp is slow on a CPU."""
CLOSE = 1e-3
"""Largest accepted difference between the engines, relative to 1 + |value|."""


def engines(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that the task runs on the GPU engine, and that reset and step agree with the CPU engine within rounding."""
    warp = _warp_env(subject, subject.resolved.task.decimation)
    env = subject.env(episode_steps=EPISODE, flags={"scene.num_envs": FEW_WORLDS})
    hint = "reset with methods of `selection` and tensors of the engine only; or set sim.engine: batch, for CPUs only"
    action = next(random_actions(env, subject.bound))
    outputs = []
    for one in (env, warp):
        torch.manual_seed(0)  # draws from torch's own generator are checked by `same-seed`
        outputs.append((one.reset(seed=one.seed), step_outputs(one.step(action.clone()))))
    warp.check()
    for when, cpu, gpu in zip(("at the start", "after a step"), *outputs, strict=True):
        for name, values in cpu.items():
            others = gpu[name].to(values.device)
            make, found, expected, where = error_at, "", "", ""
            if values.shape != others.shape or values.dtype != others.dtype:
                found, expected = (f"{tuple(tensor.shape)} {tensor.dtype}" for tensor in (others, values))
            elif bool((far := (values.float() - others.float()).abs() > CLOSE * (1.0 + values.float().abs())).any()):
                index = tuple(far.nonzero()[0].tolist())
                make, where = warning_at, f" in environment {index[0]}"
                found, expected = (f"{float(tensor[index]):.5g}" for tensor in (others, values))
            if found:
                message = f"{name} is {expected} on the CPU engine and {found} on the GPU engine{where}, {when}"
                yield make("sim.engine = warp", message, hint)
                return


def captured(subject: TaskUnderTest) -> Iterator[Finding]:
    """Check that a step on a GPU needs no host sync, so that it can be recorded once and replayed."""
    if subject.is_direct:
        env = subject.recording().env
        if isinstance(env, DirectEnv) and env.not_recorded is not None:
            raise NotRunError(env.not_recorded)
        if type(task_of(env)).reset_idx is not DirectTask.reset_idx:
            raise NotRunError(
                "reset_idx takes ids, which a CUDA graph cannot record; write `reset(selection)` to run on a GPU"
            )
    # one physics step for each environment step: only the task's own code is checked here, and the physics is slow
    env = _warp_env(subject, decimation=1)
    action = torch.zeros(FEW_WORLDS, env.layout.action_size)
    env.reset(seed=env.seed)
    env.step(action)
    try:
        with HostSyncGuard():  # type: ignore[no-untyped-call]  # torch has no type here
            for _ in range(EPISODE + 1):
                env.step(action)
    except HostSyncError as error:
        hint = "compute with torch.where and masks over all rows: docs/tutorials/train-on-a-gpu.md"
        hint += "; else a GPU is several times slower"
        yield warning_at(subject.location(error), f"{error}, in a step", hint)


def _warp_env(subject: TaskUnderTest, decimation: int) -> VecEnv:
    """Return two environments of a task on the GPU engine (MuJoCo Warp), which runs on Warp's CPU device.

    Args:
        subject: the task.
        decimation: number of physics steps in an environment step.

    Raises:
        NotRunError: if MuJoCo Warp is not installed, or cannot run this model.
    """
    sim = subject.resolved.task.sim
    if sim.engine == "batch":
        raise NotRunError("the task sets sim.engine: batch, so it never runs on a GPU")
    if find_spec("mujoco_warp") is None:
        raise NotRunError(f"MuJoCo Warp is not installed; {pip_install('rlcli[gpu]')}")
    try:
        episode_s = EPISODE * decimation * sim.dt
        flags = {"decimation": decimation, "episode_length_s": episode_s}
        return subject.env(flags=flags | {"scene.num_envs": FEW_WORLDS, "sim.engine": "warp"})
    except (ConfigError, DeviceError) as error:
        raise NotRunError(f"MuJoCo Warp cannot run the model: {' '.join(error.message.split())}") from None

"""Write crash dumps: files with the last physics steps before a divergence, which `rlcli replay` simulates again.

The steps are stored as engine calls. An engine call simulates one or more physics steps from a state
(`rlcli.sim.divergence_report.Call`).
"""

import itertools
import logging
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli.config.load import Resolved
from rlcli.envs.environment_protocol import Environment
from rlcli.envs.observers import StepObserver
from rlcli.errors import MachineError
from rlcli.replay.resimulate import ReplayWorld
from rlcli.replay.trajectory import Header, World, write_trajectory
from rlcli.sim.divergence_report import MAX_DESCRIBED, Call, Divergence

_log = logging.getLogger(__name__)
CALLS = 64
"""Number of engine calls of each environment that a crash dump holds, if memory allows."""


class CrashDumper(StepObserver):
    """Observer that writes a crash dump at the first divergence of any environment, and logs a warning.

    Args:
        env: the environments; their engine is set to keep its last `CALLS` calls.
        folder: folder of the dump; created with the dump.
        parents: whether missing folders above `folder` are created, too.
    """

    def __init__(self, env: Environment, folder: Path, *, parents: bool = False) -> None:
        self._env, self._folder, self._parents = env, folder, parents
        self._absolute = folder.absolute()  # a hook of the task may change the current folder
        if env.engine.replayable is not None:
            env.engine.replayable.record_calls(CALLS)
        env.observers.add(self)

    def on_divergence(self, found: list[Divergence], pending: bool) -> None:
        """Write the crash dump of the first divergence, log a warning, and stop observing divergences.

        On a GPU, or after a disk error, there is no dump, and the warning says why. For the arguments see `write_dump`.
        """
        if not found:
            return
        env = self._env
        message = (
            f"the simulation diverged for the first time, in step {env.common_step + 1}: {found[0]}; its episode ends"
        )
        if env.engine.replayable is None:
            message += "; there is no dump: steps on a GPU cannot be replayed"
        else:
            try:
                file = self._folder / write_dump(env, found, pending, self._absolute, self._parents).name
                message += f"; dump {file}; to replay it: rlcli replay {shlex.quote(str(file))}"
            except MachineError as error:
                message += f"; there is no dump: {error.message}"
        stop_observing_divergences(env, self)
        _log.warning(message)


def stop_observing_divergences(env: Environment, observer: StepObserver) -> None:
    """Remove an observer of divergences; if no other one is left, set the engine to keep only its newest call."""
    env.observers.remove(observer)
    if not env.observers.on_divergence and env.engine.replayable is not None:
        env.engine.replayable.record_calls(1)


@dataclass(slots=True)
class CallTrace:
    """Copies of the last engine calls of one environment, from which another thread can simulate the calls again."""

    divergence: Divergence
    """The divergence. For an episode that did not diverge, `divergence.cause` is why the episode was recorded."""
    calls: list[Call]
    """The calls, oldest first."""
    final: NDArray[np.float64]
    """The integration state after the last call; before the last call, if that call is pending. (nstate,)"""
    own_model: dict[str, Tensor]
    """Fields of the model that differ between environments, with this environment's values, by name."""
    last: int
    """How many of the calls belong to the last environment step."""
    pending: bool
    """Whether the divergence was found before the last call, which the engine therefore has not made."""


def trace_calls(env: Environment, divergence: Divergence, pending: bool = False) -> CallTrace:
    """Copy the last engine calls (calls that simulate physics steps) of an environment.

    Call this function before the environment's state is restored or reset.

    Args:
        env: all environments.
        divergence: the divergence, with the index of its environment; for an episode that did not diverge, the cause
            is why the episode is recorded.
        pending: whether the divergence was found before the engine's next call; that call then becomes part of the
            copies.
    """
    engine, number = env.engine.replayable, divergence.env
    assert engine is not None
    calls, final = engine.recorded_calls(number), engine.state_row(number)
    if pending:
        calls = [*calls, Call(final, env.config.decimation)]
    fields = engine.own_model_fields(number)
    own_model = {name: torch.from_numpy(np.atleast_1d(values)) for name, values in fields.items()}
    return CallTrace(divergence, calls, final, own_model, 1 if pending else env.calls_per_step, pending)


def describe_traces(
    traces: Sequence[CallTrace], model: mujoco.MjModel, resolved: Resolved, follows_constants: bool, *, diverged: bool
) -> tuple[list[World], dict[str, Tensor]]:
    """Simulate engine calls again, and convert them to the form of a trajectory file.

    Args:
        traces: the copied calls, one item for each environment.
        model: the model of all environments.
        resolved: the configuration.
        follows_constants: whether the constants that MuJoCo derives from a model (`mj_setConst`) are derived again from
            each environment's own model fields.
        diverged: whether the calls end in a divergence; if so, its physics step is found and stored.

    Returns:
        The `World` of each environment for the file's header, and the file's tensors (`world.K.*`), by name.
    """
    worlds, tensors = [], {}
    for number, trace in enumerate(traces):
        world, calls = ReplayWorld(model, resolved, trace.own_model, follows_constants), trace.calls
        final = world.simulate(calls[-1]) if trace.pending else trace.final
        first = max(0, len(calls) - trace.last)
        described = World(
            env=trace.divergence.env,
            cause=trace.divergence.cause,
            detail=trace.divergence.detail,
            nstep=[call.nstep for call in calls],
            follows=[
                world.differing_field(following.state, world.simulate(call), final=False) is None
                for call, following in itertools.pairwise(calls)
            ],
            first=first,
            diverged_at=world.find_divergence(calls, first) if diverged else None,
        )
        worlds.append(described)
        tensors[f"world.{number}.states"] = torch.from_numpy(np.stack([call.state for call in calls]))
        tensors[f"world.{number}.final"] = torch.from_numpy(final)
        tensors |= {f"world.{number}.model.{name}": values for name, values in trace.own_model.items()}
    return worlds, tensors


def write_dump(env: Environment, found: list[Divergence], pending: bool, folder: Path, parents: bool) -> Path:
    """Write a crash dump with the last engine calls of the environments that diverged.

    Args:
        env: the environments, before the diverged states are restored.
        found: the divergences; only the first `MAX_DESCRIBED` are written.
        pending: whether the divergences were found before the engine's next call; that call is then simulated for the
            dump.
        folder: folder of the file; created if it does not exist.
        parents: whether missing folders above `folder` are created, too.

    Returns:
        The written file. No existing file is overwritten.

    Raises:
        MachineError: if the disk reports an error, the folder is a link, or it is full of dumps of this step.
    """
    if folder.is_symlink():  # the link may come from an unpacked archive and lead anywhere
        raise MachineError(f"{folder} is a link, through which rlcli does not write; remove it")
    engine = env.engine.replayable
    assert engine is not None
    traces = [trace_calls(env, divergence, pending) for divergence in found[:MAX_DESCRIBED]]
    for trace in traces:
        trace.calls = trace.calls[-CALLS - 1 :]
    constants = engine.own_constants
    worlds, tensors = describe_traces(traces, engine.model, env.resolved, constants, diverged=True)
    header = Header.of(env).model_copy(update={"kind": "crash", "worlds": worlds, "follows_constants": constants})
    names = (f"step-{env.common_step:012d}{end}" for end in ("", *(f"-{number}" for number in range(2, 10_000))))
    files = (folder / f"{name}.safetensors" for name in names)
    file = next((file for file in files if not os.path.lexists(file)), None)
    if file is None:
        raise MachineError(f"{folder} already has 9,999 crash dumps of step {env.common_step}; remove some of them")
    write_trajectory(file, header, tensors, parents=parents)
    return file

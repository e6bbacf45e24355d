"""Main function of a worker process, which steps one shard until the main process closes the connection or ends."""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import random
import signal
import socket
import sys
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.envs.sharding.channel import SPIN_S, Channel, ChannelClosedError
from rlcli.errors import RlcliError, TaskError
from rlcli.machine.memory import memory_error
from rlcli.registry.changed_modules import ModuleCopies, change_of_module
from rlcli.registry.task_code_monitor import error_of_task, exit_refused, observe_task_code

if TYPE_CHECKING:
    from torch import Tensor

    from rlcli.config.load import Resolved
    from rlcli.envs.shard_range import Shard
    from rlcli.envs.sharding.arrays import ArraySpec
    from rlcli.envs.sharding.shard_step import Stage
    from rlcli.envs.vec_env import VecEnv

BUILD, MAP, SHARE, STEP, RESET, LOAD, CALL, CONTINUE = b"b", b"m", b"h", b"s", b"r", b"l", b"c", b"g"
"""Kinds of the messages that the main process sends: build the shard; map the shared tensors of the steps; add other
shared tensors; step; reset; load a state; call a function; continue after a stage."""
READY, STOPPED, VALUE, ERROR, WARNING = b"y", b"t", b"v", b"e", b"w"
"""Kinds of the messages that a worker sends: its shard is built; it stopped at a stage; value of a call; an error; a
warning, which may come at any time."""


@dataclass(frozen=True, slots=True)
class Job:
    """Data that a worker receives once, and from which it builds its shard."""

    resolved: bytes
    """Configuration of the shard, pickled."""
    seed: int
    shared_streams: int
    shard: Shard
    number: int
    """Index of the shard."""
    files: list[tuple[Path, str]]
    """Task files that the main process has imported; `resolved` may contain their functions and classes."""
    has_own_code: bool
    """Whether the task has code that is not tested with several workers (`has_untested_code`)."""
    generator_state: Tensor
    """State of torch's global generator at the start: a task may use it while it is built."""


def main(connection: int, arrays: int) -> None:
    """Serve the main process until it ends or closes the connection.

    Args:
        connection: file descriptor of the socket to the main process.
        arrays: file descriptor of the file of the shared tensors.
    """
    for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1"):  # the main process decides when its workers end
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    channel = Channel(socket.socket(fileno=connection), SPIN_S)
    # ChannelClosedError: the main process has ended or has closed the environment; other errors: too little memory to
    # report an error. The main process names the exit code of a worker that ended by itself.
    logging.getLogger("rlcli").addHandler(_WarningSender(channel))
    with contextlib.suppress(BaseException):
        try:
            with observe_task_code(), exit_refused():
                _serve(channel, arrays)
        except ChannelClosedError:
            raise
        except BaseException as error:  # an import failed, or a message is unreadable
            channel.send(ERROR, _PortableError.from_exception(error))
            channel.wait_until_closed()
    os._exit(0)  # without waiting for the engine's threads


class _WarningSender(logging.Handler):
    """Logging handler that sends warnings to the main process, which logs them."""

    def __init__(self, channel: Channel) -> None:
        super().__init__(logging.WARNING)
        self._channel = channel

    def emit(self, record: logging.LogRecord) -> None:
        """Send one log record."""
        with contextlib.suppress(ChannelClosedError):
            self._channel.send(WARNING, record.getMessage())


def _serve(channel: Channel, arrays: int) -> None:
    import torch  # torch is imported while the main process builds its own shard

    import rlcli.envs.managed
    import rlcli.envs.sharding.shard_step  # noqa: F401

    torch.set_num_threads(1)
    worker = _Worker(channel, arrays)
    copies = ModuleCopies()
    with torch.no_grad():
        while True:
            kind, content = channel.receive()
            try:
                worker.handle(kind, content)
            except ChannelClosedError:
                raise
            except:  # noqa: E722 - the task may have deleted the name BaseException
                broken = copies.restore()
                error = sys.exception()
                assert error is not None
                lost = copies.error_of_lost_modules(error)
                channel.send(ERROR, _PortableError.from_exception(error, broken, lost))


class _Worker:
    def __init__(self, channel: Channel, arrays: int) -> None:
        self._channel, self._arrays = channel, arrays
        self._env: VecEnv | None = None
        self._check: Callable[[], None] = lambda: None
        self._step_mode: Callable[[], contextlib.AbstractContextManager[Any]] = contextlib.nullcontext

    def handle(self, kind: bytes, content: Any) -> None:
        """Execute the request of a message (step, reset, call, ...), and reply."""
        if kind == STEP:
            with self._step_mode():
                self._runner.step()
        elif kind == RESET:
            self._runner.reset(*content)
        elif kind == LOAD:
            self._runner.load(content)
        elif kind == CALL:
            self._call(content)
        elif kind == BUILD:
            self._build(content)
            self._channel.send(READY)
        elif kind == SHARE:
            self._share(*content)
            self._channel.send(READY)
        else:
            self._map(content)
            self._channel.send(READY)

    def _build(self, job: Job) -> None:
        import torch

        from rlcli.envs.make import make_env
        from rlcli.envs.sharding.arrays import map_tensors
        from rlcli.envs.sharding.shard_step import counter_specs
        from rlcli.registry.task_imports import import_again

        torch.set_rng_state(job.generator_state)
        counters = map_tensors(self._arrays, counter_specs(job.shard.total))["counters"]
        shard = replace(job.shard, counters=counters[:, job.shard.rows])
        self._number = job.number
        if job.has_own_code:
            self._check = _GlobalGenerators().require_unused
        else:  # inference mode takes a tenth of the time off each operation, but a task's own code might need gradients
            self._step_mode = torch.inference_mode
        import_again(job.files)
        resolved: Resolved = pickle.loads(job.resolved)
        self._env = make_env(resolved, seed=job.seed, shared_streams=job.shared_streams, shard=shard)
        self._check()

    def _map(self, specs: Mapping[str, ArraySpec]) -> None:
        from rlcli.envs.sharding.arrays import map_tensors
        from rlcli.envs.sharding.shard_step import ShardRunner

        assert self._env is not None
        self._runner = ShardRunner(self._env, self._number, map_tensors(self._arrays, specs), self._stop, self._check)

    def _share(self, specs: Mapping[str, ArraySpec], names: list[str]) -> None:
        from rlcli.envs.sharding.arrays import map_tensors

        assert self._env is not None
        tensors = map_tensors(self._arrays, specs)
        self._env.shard.shared.update({name: tensors[name] for name in names})

    def _stop(self, stage: Stage, content: Any) -> None:
        """Report a stage; serve calls until the main process continues the step."""
        from rlcli.envs.sharding.shard_step import Stage

        self._channel.send(STOPPED + bytes([stage]), content)
        while stage != Stage.DONE:
            kind, call = self._channel.receive()
            if kind == CONTINUE:
                return
            self._call(call)

    def _call(self, content: tuple[Any, tuple[Any, ...]]) -> None:
        function, arguments = content
        self._channel.send(VALUE, (function(self._env, *arguments),))


class _GlobalGenerators:
    """Detector of draws from global random generators; each process has its own, so results would depend on workers."""

    def __init__(self) -> None:
        self._states = self._read_states()

    def require_unused(self) -> None:
        """Check that no random number has been drawn since this object was made.

        Raises:
            TaskError: with the library whose generator was used.
        """
        used = [name for name, state in self._read_states().items() if state != self._states[name]]
        if used:
            raise TaskError(
                f"the task uses the global random generator of {used[0]}; with several workers the"
                " results would depend on the number of workers",
                hint="set scene.workers: 1, or use the selection's random numbers (`selection.uniform`, `self.draws`)",
            )

    @staticmethod
    def _read_states() -> dict[str, Any]:
        import numpy as np
        import torch

        name, key, *position = np.random.get_state(legacy=True)
        return {
            "torch": torch.get_rng_state().numpy().tobytes(),
            "numpy": (name, np.asarray(key).tobytes(), *position),
            "Python": random.getstate(),
        }


@dataclass(frozen=True, slots=True)
class _PortableError:
    """Copy of an exception that can be pickled, so that a worker can send it to the main process."""

    kind: type[BaseException]
    arguments: tuple[Any, ...]
    attributes: dict[str, Any]
    trace: str

    @staticmethod
    def from_exception(
        error: BaseException, broken: TaskError | None = None, lost: TaskError | None = None
    ) -> _PortableError:
        """Return the copy of an exception that a worker sends.

        An exception in the task's code becomes a TaskError that names the line of code. `broken` replaces an exception
        that would be reported as a bug of rlcli: a task has broken built-in functions. `lost` does this if no line of
        the task's code is found that changes a module: a task has removed modules.
        """
        trace = "".join(traceback.format_exception(error))
        if not isinstance(error, RlcliError):
            known = memory_error(error) or error_of_task(error) or broken
            error = known or change_of_module(error) or lost or error
        if isinstance(error, RlcliError):
            return _PortableError(type(error), error.args, dict(error.__dict__), trace)
        if type(error).__module__ == "builtins":
            return _PortableError(type(error), tuple(map(str, error.args)), {}, trace)
        return _PortableError(RuntimeError, (f"{type(error).__name__}: {error}",), {}, trace)

    def rebuild(self) -> BaseException:
        """Return the exception, with the worker's traceback as a note."""
        error = self.kind.__new__(self.kind)
        error.args = self.arguments
        error.__dict__.update(self.attributes)
        error.add_note(f"in a worker process:\n{self.trace}")
        return error

"""Pool of an environment's worker processes, as the main process starts, uses and ends them.

`ShardedEnv` sends its requests through the pool, and gets errors and warnings of the workers back.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import weakref
from collections.abc import Iterator, Sequence
from typing import Any

from rlcli.envs.sharding import worker
from rlcli.envs.sharding.channel import SPIN_S, Channel, ChannelClosedError
from rlcli.envs.sharding.worker import Job
from rlcli.errors import MachineError
from rlcli.machine.memory import require_address_space
from rlcli.machine.processes import python_command
from rlcli.registry.task_code_monitor import warn_once

_CODE = (
    "import sys, json; sys.path[:] = json.loads(sys.argv[3]);"
    " from rlcli.envs.sharding.worker import main; main(int(sys.argv[1]), int(sys.argv[2]))"
)
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
_CLOSE_S = 5.0
"""Time after which workers that do not end are killed [s]."""
_SILENT_S = 30.0
"""Time after which a warning names a worker that does not answer [s]."""
_log = logging.getLogger(__name__)


class Worker:
    """One worker process.

    Args:
        number: index of the shard that the worker steps.
        arrays: descriptor of the file of the shared tensors.
    """

    def __init__(self, number: int, arrays: int) -> None:
        self.number = number
        ours, theirs = socket.socketpair()
        command = python_command("-c", _CODE, str(theirs.fileno()), str(arrays), _search_path())
        with theirs:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=2,  # standard output has the results of the command
                pass_fds=(theirs.fileno(), arrays),
                env={**os.environ, **_ONE_THREAD},
            )
        self._channel = Channel(ours, SPIN_S)
        self._was_named = False
        """Whether this process has already warned that the worker does not answer."""

    def send(self, kind: bytes, content: Any = None) -> None:
        """Send a message.

        Raises:
            MachineError: if the process has ended.
        """
        try:
            self._channel.send(kind, content)
        except ChannelClosedError:
            raise self._ended_error() from None

    def receive(self) -> tuple[bytes, Any]:
        """Wait for a message.

        Raises:
            MachineError: if the process has ended.
            BaseException: an error of the worker.
        """
        try:
            while True:
                kind, content = self._channel.receive(self._warn_if_silent)
                if kind != worker.WARNING:
                    break
                warn_once(content)
        except ChannelClosedError:
            raise self._ended_error() from None
        if kind == worker.ERROR:
            raise content.rebuild()
        return kind, content

    @property
    def pid(self) -> int:
        """Process id of the worker."""
        return self._process.pid

    def has_ended(self) -> bool:
        """Return whether the worker process has ended."""
        return self._process.poll() is not None

    def disconnect(self) -> None:
        """Close the connection, so that the process ends; continue a process that a signal has stopped."""
        self._channel.close()
        if os.name == "posix" and not self.has_ended():
            self._process.send_signal(signal.SIGCONT)

    def wait(self, seconds: float) -> None:
        """Wait for the end of the process; kill it if it still runs after `seconds`."""
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _warn_if_silent(self) -> None:
        """Wait for a message; if the worker sends none for `_SILENT_S` seconds, log a warning, once."""
        if not self._was_named and self._channel.is_silent(_SILENT_S):
            self._was_named = True
            _log.warning(
                "worker process %s of the environment (pid %s) has not answered for %g s; if it was stopped,"
                " `kill -CONT %s` continues it; else end this command and resume the run",
                self.number,
                self.pid,
                _SILENT_S,
                self.pid,
            )

    def _ended_error(self) -> MachineError:
        """Return the error for a process that has ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_CLOSE_S)
        code = self._process.returncode
        how = "closed its connection" if code is None else f"ended with exit code {code}"
        if code is not None and code < 0:
            how = f"was ended by {signal.Signals(-code).name}"
        hint = "if memory is full, lower scene.num_envs or scene.workers"
        return MachineError(
            f"worker process {self.number} of the environment (pid {self._process.pid}) {how}", hint=hint
        )


class Workers:
    """All worker processes of an environment; they end when this object is closed or deleted.

    Args:
        count: number of processes; the constructor starts them, and they import their modules before `build` is called.

    Raises:
        MachineError: if a limit such as `ulimit -v` leaves no room for torch.
    """

    def __init__(self, count: int) -> None:
        require_address_space()
        self.arrays = _create_shared_file()
        self._workers: list[Worker] = []
        self.close = weakref.finalize(self, _close, self._workers, self.arrays)
        try:
            for number in range(1, count + 1):
                self._workers.append(Worker(number, self.arrays))
        except BaseException:
            self.close()
            raise

    def build(self, jobs: Sequence[Job]) -> None:
        """Let each process build its shard, while the caller builds its own."""
        for process, job in zip(self._workers, jobs, strict=True):
            process.send(worker.BUILD, job)

    def __len__(self) -> int:
        return len(self._workers)

    def __iter__(self) -> Iterator[Worker]:
        return iter(self._workers)

    def request(self, kind: bytes, content: Any = None) -> None:
        """Send a message to every worker."""
        for process in self._workers:
            process.send(kind, content)

    def replies(self) -> list[Any]:
        """Wait for one reply of every worker; return the contents of the replies, in the order of the workers.

        Raises:
            MachineError: if a process has ended.
            BaseException: the first error that a worker sent, after all have replied.
            KeyboardInterrupt: at once; the workers cannot be used any more.
        """
        contents, first_error = [], None
        for process in self._workers:
            try:
                contents.append(process.receive()[1])
            except KeyboardInterrupt:
                raise
            except BaseException as error:
                first_error = first_error or error
        if first_error is not None:
            raise first_error
        return contents


_early: list[Workers] = []
"""Worker processes that were started before their environment is built."""


def start_early(count: int) -> None:
    """Start `count` workers for the next environment.

    Call this function before torch is imported, so that this process and the workers import at the same time.
    """
    if count:
        _early.append(Workers(count))


def take_workers(count: int) -> Workers:
    """Return `count` worker processes: those that `start_early` started if their number fits, else new processes."""
    if _early and len(_early[-1]) == count:
        return _early.pop()
    close_early()
    return Workers(count)


def close_early() -> None:
    """End the processes that were started early and that no environment has taken."""
    while _early:
        _early.pop().close()


def _create_shared_file() -> int:
    """Create a file in memory without a name and return its descriptor; it disappears with the last process."""
    if hasattr(os, "memfd_create"):
        return os.memfd_create("rlcli")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())


def _close(workers: list[Worker], arrays: int) -> None:
    for process in workers:
        process.disconnect()
    end = time.monotonic() + _CLOSE_S
    for process in workers:
        process.wait(max(0.0, end - time.monotonic()))
    workers.clear()
    os.close(arrays)


def _search_path() -> str:
    """Return `sys.path` without the current folder, as JSON for the command line of a worker."""
    return json.dumps([entry for entry in sys.path if entry])

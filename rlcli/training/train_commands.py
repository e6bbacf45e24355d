"""Start and control `rlcli train` commands in subprocesses, for sweeps and for several seeds.

A signal that stops this process also stops all trainings in subprocesses.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rlcli.envs.sharding.worker_count import ONE_WORKER
from rlcli.errors import STOPPED, RlcliError
from rlcli.machine.processes import python_command
from rlcli.training.signals import StopRequest

_log = logging.getLogger(__name__)

STOP_WITH_PARENT = "RLCLI_LEASH"
"""Environment variable with which a subprocess stops when its parent process ends (its standard input then closes)."""
LOG = "train.log"
"""File in a run with the messages of its process."""
POLL_S = 0.1
"""Time between two checks of running processes [s]."""


@dataclass(slots=True)
class TrainingProcess:
    """Subprocess that runs an `rlcli` command (train or eval) for one run."""

    run: Path
    """Folder of the run."""
    process: subprocess.Popen[bytes]
    stop_requested: bool = False
    """Whether `stop` was called."""
    document: dict[str, Any] = field(default_factory=dict)
    """JSON document that the process has printed; empty while it runs."""

    def stop(self) -> None:
        """Send SIGTERM once: the training writes a checkpoint and ends. Later calls do nothing."""
        if not self.stop_requested:
            self.stop_requested = True
            with contextlib.suppress(OSError):
                self.process.terminate()

    def has_ended(self) -> bool:
        """Return whether the process has ended; if so, read the JSON document that it has printed."""
        if self.process.poll() is None:
            return False
        if not self.document:
            output, _ = self.process.communicate()  # also closes the pipes
            with contextlib.suppress(ValueError):
                self.document = json.loads(output)
        return True

    @property
    def exit_code(self) -> int:
        """Exit code in the form of a shell: 128 + N after signal N."""
        code = self.process.returncode
        return 128 - code if code < 0 else code

    @property
    def has_failed(self) -> bool:
        """Whether the process has ended with an error; a requested stop is not an error."""
        return self.exit_code != 0 and not (self.stop_requested and self.exit_code == STOPPED)

    def error(self) -> RlcliError:
        """Return the error that the process has printed, or if there is none, an error with the path of its log."""
        printed = self.document.get("error")
        if not isinstance(printed, dict):
            error = RlcliError(f"rlcli ended with exit code {self.exit_code}; its messages are in {self.run / LOG}")
        else:
            error = RlcliError(str(printed.get("message")).split("\n"))
            error.kind = str(printed.get("kind"))
        error.exit_code = self.exit_code
        return error


def start_command(run: Path, words: Sequence[str]) -> TrainingProcess:
    """Start `rlcli WORDS --json` in a subprocess; its messages are appended to the file `LOG` in the run's folder."""
    # a new process group: Ctrl-C reaches the subprocess once, through this process
    group = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP} if os.name == "nt" else {"start_new_session": True}  # type: ignore[attr-defined]
    with (run / LOG).open("ab") as log:
        process = subprocess.Popen(
            python_command("-m", "rlcli", *words, "--json"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            env={**os.environ, STOP_WITH_PARENT: "1", ONE_WORKER: "1"},
            **group,
        )
    return TrainingProcess(run, process)


def start_training(run: Path, device: str, options: Sequence[str] = ()) -> TrainingProcess:
    """Start the training of a run that has not started yet, or resume an interrupted run."""
    return start_command(run, ["train", "--resume", str(run), "--device", device, *options])


def stop_with_parent() -> None:
    """End this process with SIGTERM when its parent ends, if the parent is an `rlcli` that runs several trainings."""
    if os.environ.pop(STOP_WITH_PARENT, None) is None:
        return
    pipe = os.dup(0)

    def wait() -> None:
        with contextlib.suppress(OSError):
            while os.read(pipe, 64):
                pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True, name="parent").start()


def train_all(
    runs: Iterable[Path], device: str, jobs: int, options: Sequence[str], stop: StopRequest, poll: Callable[[], None]
) -> list[TrainingProcess]:
    """Train runs in subprocesses until all have ended; after a signal stop all processes and start no more.

    Args:
        runs: folders of the runs.
        device: device of the trainings.
        jobs: largest number of processes at a time.
        options: further options of each `rlcli train` command.
        stop: stores whether a signal has requested a stop.
        poll: called every `POLL_S` seconds while processes run.

    Returns:
        The processes in the order in which they have ended.
    """
    waiting = list(runs)
    active: list[TrainingProcess] = []
    ended: list[TrainingProcess] = []
    try:
        while waiting or active:
            if stop.signal is not None:
                waiting = []
                for process in active:
                    process.stop()
            while waiting and len(active) < jobs:
                active.append(start_training(waiting.pop(0), device, options))
                _log.debug("%s starts", active[-1].run.name)
            for process in [process for process in active if process.has_ended()]:
                active.remove(process)
                ended.append(process)
                if process.exit_code and not process.stop_requested:
                    _log.warning("%s: %s", process.run.name, process.error().message)
            poll()
            time.sleep(POLL_S)
    finally:
        for process in active:  # after an error some subprocesses may still run
            process.process.kill()
    return ended

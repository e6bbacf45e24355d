"""Trainings in subprocesses: `rlcli` commands that are started in turn, watched, and stopped together."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.errors import RlcliError

if TYPE_CHECKING:
    from rlcli.training.signals import StopRequest

_log = logging.getLogger(__name__)

STOP_WITH_PARENT = "RLCLI_LEASH"
"""Environment variable of a process that stops when its parent ends, which closes the process's standard input."""
LOG = "train.log"
"""File of a run with the messages of its process."""
POLL_S = 0.1
"""Time between two looks at running processes."""
STOPPED = 75
"""Exit code of a training that was stopped by SIGTERM."""


@dataclass(slots=True)
class TrainingProcess:
    """Subprocess with a command for one run."""

    run: Path
    process: subprocess.Popen[bytes]
    stop_requested: bool = False
    document: dict[str, Any] = field(default_factory=dict)
    """The JSON document that the process printed, once it has ended."""

    def stop(self) -> None:
        """Request a stop at the next step, with a checkpoint; further calls do nothing."""
        if not self.stop_requested:
            self.stop_requested = True
            with contextlib.suppress(OSError):
                self.process.terminate()

    def has_ended(self) -> bool:
        """Return whether the process has ended; read its document then."""
        if self.process.poll() is None:
            return False
        if not self.document:
            assert self.process.stdout is not None
            output = self.process.stdout.read()
            with contextlib.suppress(ValueError):
                self.document = json.loads(output)
            self.process.stdout.close()
            if self.process.stdin is not None:
                with contextlib.suppress(OSError):
                    self.process.stdin.close()
        return True

    @property
    def exit_code(self) -> int:
        """The exit code as a shell gives it."""
        code = self.process.returncode
        return 128 - code if code < 0 else code

    @property
    def has_failed(self) -> bool:
        """Whether the process ended with an error other than being stopped."""
        return self.exit_code != 0 and not (self.stop_requested and self.exit_code == STOPPED)

    def error(self) -> RlcliError:
        """Return the error that the process printed, or one that names its log."""
        printed = self.document.get("error")
        if not isinstance(printed, dict):
            error = RlcliError(f"its process ended with {self.exit_code}; {self.run / LOG} has what it said")
        else:
            error = RlcliError(str(printed.get("message")))
            error.kind = str(printed.get("kind"))
        error.exit_code = self.exit_code
        return error


def start_command(run: Path, words: Sequence[str]) -> TrainingProcess:
    """Start `rlcli WORDS --json` in a subprocess; its messages are appended to a log in the run."""
    # a process group of its own: Ctrl-C reaches the subprocess once, through this process
    group = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP} if os.name == "nt" else {"start_new_session": True}  # type: ignore[attr-defined]
    with (run / LOG).open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "rlcli", *words, "--json"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            env={**os.environ, STOP_WITH_PARENT: "1"},
            **group,
        )
    return TrainingProcess(run, process)


def start_training(run: Path, device: str, options: Sequence[str] = ()) -> TrainingProcess:
    """Start the training of a run that waits, or resume one that was interrupted."""
    return start_command(run, ["train", "--resume", str(run), "--device", device, *options])


def stop_with_parent() -> None:
    """Send this process SIGTERM when its parent ends, if the parent is `rlcli`."""
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
    runs: Iterable[Path],
    device: str,
    jobs: int,
    options: Sequence[str],
    stop: StopRequest,
    poll: Callable[[], None],
) -> list[TrainingProcess]:
    """Train runs in subprocesses until all have ended; after a signal start no more and stop those that train.

    Args:
        runs: their folders.
        device: where they train.
        jobs: number of processes at a time.
        options: further options of each command.
        stop: the request to stop by a signal.
        poll: called regularly.

    Returns:
        The processes in the order in which they ended.
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
                _log.debug("%s begins", active[-1].run.name)
            for process in [process for process in active if process.has_ended()]:
                active.remove(process)
                ended.append(process)
                if process.exit_code and not process.stop_requested:
                    _log.warning("%s: %s", process.run.name, process.error().message)
            poll()
            time.sleep(POLL_S)
    finally:
        for process in active:  # not empty only after an error
            process.process.kill()
    return ended

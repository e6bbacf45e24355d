"""Trainings of a study, each a process of its own: started in turn, watched, and stopped together."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

LEASH = "RLCLI_LEASH"
"""Environment variable of a process that ends when what started it does: its standard input is closed then."""
LOG = "train.log"
"""Of a run: what its process said."""
_LOOK_S = 0.1


@dataclass(slots=True)
class Child:
    """The process that trains one run."""

    run: Path
    process: subprocess.Popen[bytes]
    asked: bool = False
    """Whether it was asked to stop."""
    document: dict[str, Any] = field(default_factory=dict)
    """What it said on stdout, once it has ended."""

    def stop(self) -> None:
        """Ask it to stop at its next step, with a checkpoint; twice asked it is not."""
        if not self.asked:
            self.asked = True
            with contextlib.suppress(OSError):
                self.process.terminate()

    def has_ended(self) -> bool:
        """Whether it has; its document is read then."""
        if self.process.poll() is None:
            return False
        if not self.document:
            assert self.process.stdout is not None
            said = self.process.stdout.read()
            with contextlib.suppress(ValueError):
                self.document = json.loads(said)
            self.process.stdout.close()
            if self.process.stdin is not None:
                with contextlib.suppress(OSError):
                    self.process.stdin.close()
        return True

    @property
    def exit_code(self) -> int:
        """Its exit code as a shell gives it."""
        code = self.process.returncode
        return 128 - code if code < 0 else code

    @property
    def why(self) -> str:
        """What it says was wrong."""
        error = self.document.get("error")
        if isinstance(error, dict):
            return str(error.get("message"))
        return f"its process ended with {self.exit_code}; {self.run / LOG} has what it said"


def start(run: Path, words: Sequence[str]) -> Child:
    """A process that runs `rlcli WORDS --json` for a run, what it says kept beside the run."""
    own = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP} if os.name == "nt" else {"start_new_session": True}  # type: ignore[attr-defined]
    with (run / LOG).open("ab") as log:
        process = subprocess.Popen(  # a group of its own: Ctrl-C reaches it through us, once
            [sys.executable, "-m", "rlcli", *words, "--json"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            env={**os.environ, LEASH: "1"},
            **own,
        )
    return Child(run, process)


def train(run: Path, device: str, words: Sequence[str] = ()) -> Child:
    """The process that trains a run that waits, or goes on with one that was interrupted; `words` are more options."""
    return start(run, ["train", "--resume", str(run), "--device", device, *words])


def on_leash() -> None:
    """Stop this process, as a scheduler would, when the one that started it is gone."""
    if os.environ.pop(LEASH, None) is None:
        return
    pipe = os.dup(0)

    def wait() -> None:
        with contextlib.suppress(OSError):
            while os.read(pipe, 64):
                pass
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True, name="leash").start()


def run_all(
    runs: Sequence[Path],
    device: str,
    jobs: int,
    *,
    words: Sequence[str] = (),
    stopped: Callable[[], bool],
    tell: Callable[[Child, bool], None],
    look: Callable[[], None],
) -> dict[Path, Child]:
    """Train runs, so many at a time, until all have ended.

    Args:
        runs: their folders.
        device: where they train.
        jobs: processes at a time.
        words: further options of each.
        stopped: whether to stop; no further run is begun then, and those that train are asked to stop.
        tell: hears of a process that was started, and (True) of one that has ended.
        look: called now and then.
    """
    waiting, active, ended = list(runs), [], {}  # type: list[Path], list[Child], dict[Path, Child]
    try:
        while waiting or active:
            if stopped():
                waiting = []
                for child in active:
                    child.stop()
            while waiting and len(active) < jobs:
                active.append(train(waiting.pop(0), device, words))
                tell(active[-1], False)
            for child in [child for child in active if child.has_ended()]:
                active.remove(child)
                ended[child.run] = child
                tell(child, True)
            look()
            time.sleep(_LOOK_S)
    finally:
        for child in active:  # only where something went wrong
            child.process.kill()
    return ended

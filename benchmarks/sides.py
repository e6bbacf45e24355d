"""Programs that are timed in turn: child processes that run a block of their work on request.

A child is a Python script, possibly in another virtual environment, that passes its methods to `serve`. This module is
the only code that all children share; it needs only the standard library. Requests and results are lines of JSON.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
CHECKOUT = {"PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE.parent / "tasks")])}
"""Variables with which this process's own Python imports the measured checkout, whichever version is installed."""
CACHE = HERE.parent / ".bench"
LOGS = CACHE / "logs"
Block = Callable[[int], float]
"""Function that returns the seconds of a number of steps."""


clock = time.process_time if os.environ.get("RLCLI_BENCH_CLOCK") == "cpu" else time.perf_counter
"""Clock for blocks. `RLCLI_BENCH_CLOCK=cpu` counts the processor time of all threads of a side: for studies of
ratios on a busy machine, with one thread."""


class Failed(Exception):
    """Raised if a side could not be started, or failed; the reason is shown in its row."""


class Side:
    """Child process. `side("step", steps=3)` calls its method `step` and returns the result.

    Args:
        name: name of its log file in `.bench/logs`.
        command: the program and its arguments.
        timeout: seconds until a result must arrive, unless a call gives another limit.
        environment: variables that differ from those of this process.

    Raises:
        Failed: from calls, if the child ends, raises, or exceeds the time limit.
    """

    def __init__(
        self, name: str, command: Sequence[str], *, timeout: float = 300.0, environment: Mapping[str, str] | None = None
    ) -> None:
        self.name, self.timeout = name, timeout
        LOGS.mkdir(parents=True, exist_ok=True)
        self._log = LOGS / f"{name}.txt"
        with self._log.open("w") as log:
            self._process = subprocess.Popen(
                list(command),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                bufsize=1,
                env=child_environment(environment),
                start_new_session=True,
            )

    def __call__(self, method: str, *, timeout: float | None = None, **arguments: Any) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps({"method": method, "arguments": arguments}) + "\n")
        except (OSError, ValueError):  # the child has closed the pipe
            raise self._failure("ended") from None
        limit = self.timeout if timeout is None else timeout
        if not select.select([self._process.stdout], [], [], limit)[0]:
            self.close()
            raise self._failure(f"did not answer {method} within {limit:.0f} s")
        line = self._process.stdout.readline()
        if not line:
            raise self._failure("ended")
        answer = json.loads(line)
        if "error" in answer:
            raise Failed(f"{self.name}: {answer['error']}")
        return answer["result"]

    def close(self) -> None:
        """End the child and its own subprocesses, and wait for it."""
        if self._process.returncode is None:  # the child is not reaped yet, so its id is still that of its group
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):  # a request may be left in its buffer
                    pipe.close()

    def _failure(self, what: str) -> Failed:
        lines = [line for line in self._log.read_text(errors="replace").splitlines() if line.strip()]
        return Failed(f"{self.name} {what}" + (f": {lines[-1].strip()[:200]}" if lines else ""))


def child_environment(changes: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return this process's variables without those for rlcli alone, so that every side runs as for its users.

    Pip has compiled the peers to bytecode; this checkout must be allowed to write its own.
    """
    own = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "PYTHONPATH", "PYTHONDONTWRITEBYTECODE")
    kept = {name: value for name, value in os.environ.items() if name not in own}
    return {**kept, **(changes or {})}


@contextlib.contextmanager
def opened(*sides: Side) -> Iterator[tuple[Side, ...]]:
    """Close the sides at the end."""
    try:
        yield sides
    finally:
        for side in sides:
            side.close()


def serve(methods: Mapping[str, Callable[..., Any]]) -> None:
    """Run the loop of a child: execute requests until stdin ends. Other prints go to the child's log."""
    answers = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    for line in sys.stdin:
        request = json.loads(line)
        try:
            answer = {"result": methods[request["method"]](**request["arguments"])}
        except Exception as error:
            import traceback

            traceback.print_exc()
            answer = {"error": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"}
        answers.write(json.dumps(answer) + "\n")


def steps_for(block: Block, seconds: float, least: int = 1) -> int:
    """Return the number of steps that take a given time, found by doubling."""
    steps = least
    while (took := block(steps)) < 0.25 * seconds:
        steps = max(2 * steps, min(16 * steps, int(0.5 * seconds / max(took, 1e-6) * steps)))
    return max(least, round(steps * seconds / took))


def alternate(blocks: Mapping[str, Block], steps: Mapping[str, int], repeats: int) -> dict[str, list[float]]:
    """Return the seconds per step of each block, one value per round; every round runs each block once, in turn."""
    found: dict[str, list[float]] = {name: [] for name in blocks}
    for _ in range(repeats):
        for name, block in blocks.items():
            found[name].append(block(steps[name]) / steps[name])
    return found


def ratio(numerator: Sequence[float], denominator: Sequence[float]) -> dict[str, float]:
    """Return median, lowest and highest of the ratios of the rounds."""
    ratios = [above / below for above, below in zip(numerator, denominator, strict=True)]
    return {"ratio": statistics.median(ratios), "ratio_min": min(ratios), "ratio_max": max(ratios)}


def wall(command: Sequence[str], environment: Mapping[str, str] | None = None, timeout: float = 300.0) -> float:
    """Return the seconds from the start of a program to its end.

    Raises:
        Failed: if it exits with an error.
    """
    begin = time.perf_counter()
    try:
        done = subprocess.run(
            list(command), capture_output=True, text=True, env=child_environment(environment), timeout=timeout
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise Failed(f"{Path(command[0]).name}: {' '.join(str(error).split())[:200]}") from None
    took = time.perf_counter() - begin
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if line.strip()] or ["no message"]
        raise Failed(f"{' '.join(map(str, command))}: exit {done.returncode}: {lines[-1].strip()[:200]}")
    return took

"""Commands as children of a warm parent process: `child(...)` starts one, `ended(...)` waits for its end."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SERVER = Path(__file__).with_name("child_server.py")
PATIENCE = 600
"""Longest time to wait for a child process [s]; other processes may use the cores."""
SMALL = ("scene.num_envs=4", "sim.engine_threads=1", "agent.torch_threads=1", "-q")


@dataclass
class Ended:
    code: int | None
    """Exit code, or minus the signal; None: it did not end in time and was killed."""
    out: str
    err: str


@dataclass
class Child:
    pid: int
    output: Path
    ask: Callable[..., dict[str, Any]]

    def ended(self, seconds: float = PATIENCE) -> Ended:
        code = self.ask(wait=self.pid, seconds=seconds)["status"]
        assert code is not None, f"did not end:\n{self.said()}"
        return Ended(code, self.output.with_suffix(".out").read_text(), self.said())

    def said(self) -> str:
        return self.output.with_suffix(".err").read_text()

    def runs(self) -> bool:
        """Return whether the process runs; a zombie does not."""
        return Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"

    def until(self, condition: Callable[[], Any], seconds: float = PATIENCE) -> Any:
        """Wait until a condition holds."""
        deadline = time.monotonic() + seconds
        while not (found := condition()):
            assert time.monotonic() < deadline, self.said()
            assert self.runs() or condition(), self.said()
            time.sleep(0.002)
        return found


@contextmanager
def warm_parent() -> Iterator[Callable[..., Child]]:
    """Yield a function that starts `rlcli ARGUMENTS` in a folder; faults are arguments of `fault_points.plant`.

    With `memory`, the child may use this many bytes more than its parent, and 60 s of processor time.
    """
    variables = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "GOMP_SPINCOUNT": "1000"}
    for name in ("RLCLI_RUNS_DIR", "RLCLI_TEST_SIZE"):
        variables.pop(name, None)
    server = subprocess.Popen(
        [sys.executable, str(SERVER)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=variables
    )
    assert server.stdin is not None
    assert server.stdout is not None
    ready = json.loads(server.stdout.readline())
    assert ready == {"ready": True, "threads": 1}, "a process with threads cannot be forked"

    def ask(**request: Any) -> dict[str, Any]:
        print(json.dumps(request), file=server.stdin, flush=True)
        return json.loads(server.stdout.readline())

    def child(
        folder: Path,
        *arguments: object,
        faults: list[dict[str, Any]] | None = None,
        ignored: tuple[str, ...] = (),
        output: Path | None = None,
        memory: int | None = None,
    ) -> Child:
        output = output or folder / f"child-{time.monotonic_ns()}"
        start = {
            "arguments": [str(a) for a in arguments],
            "folder": str(folder),
            "output": str(output),
            "faults": faults or [],
            "signals": list(ignored),
            "memory": memory,
        }
        return Child(ask(start=start)["pid"], output, ask)

    try:
        yield child
    finally:
        server.stdin.close()
        server.wait(timeout=PATIENCE)
        server.stdout.close()

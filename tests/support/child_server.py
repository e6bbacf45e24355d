"""Warm process that forks one child per command: torch is imported once, and children are real processes.

Speaks JSON lines: {"start": {...}} forks and answers with a pid, {"wait": pid, "seconds": s} with an exit status.
"""

import importlib
import json
import os
import resource
import signal
import sys
import time
from pathlib import Path

WARM = (
    "rlcli.cli.commands.train", "rlcli.cli.commands.export", "rlcli.cli.commands.play",
    "rlcli.cli.ui.progress_view", "rlcli.envs.managed", "rlcli.envs.direct",
    "rlcli.rl.sb3.trainer", "rlcli.rl.ppo.trainer",
    "rlcli.training.setup", "rlcli.training.runner",
    "rlcli.training.loggers", "rlcli.training.checkpoint_writer", "rlcli.training.loop",
    "rlcli.training.periodic_eval", "rlcli.training.start_run", "rlcli.runs.recorded_task",
    "tensorboard.summary.writer.record_writer", "torch._dynamo", "rlcli.mdp", "rlcli_tasks.cartpole",
    "tensorboard.backend.event_processing.event_file_loader", "tensorboard.summary.writer.record_writer", "rich.live",
)  # fmt: skip


def serve() -> None:
    for module in WARM:
        importlib.import_module(module)
    import torch

    from rlcli.config.load import resolve
    from rlcli.registry import find_task

    torch.set_num_threads(1)
    for task in ("cartpole", "cartpole-direct"):
        resolve(find_task(task))  # read signatures of terms and schemas once, before forking
    answer(ready=True, threads=threads_left(60.0))
    for line in sys.stdin:
        request = json.loads(line)
        if "start" in request:
            child = os.fork()
            if child == 0:
                run_child(**request["start"])
            answer(pid=child)
        else:
            answer(status=waited(request["wait"], request["seconds"]))


def threads_left(seconds: float) -> int:
    """Wait until this process has one thread, and return the number of its threads.

    An import may start a short-lived thread, which ends late on a busy machine.
    """
    deadline = time.monotonic() + seconds
    while (count := len(os.listdir("/proc/self/task"))) > 1 and time.monotonic() < deadline:
        time.sleep(0.01)
    return count


def answer(**content: object) -> None:
    print(json.dumps(content), flush=True)


def waited(pid: int, seconds: float) -> int | None:
    """Return the exit code, negative for a signal; None if the child did not end in time and was killed."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return None


def run_child(
    arguments: list[str],
    folder: str,
    output: str,
    faults: list[dict[str, object]],
    signals: list[str],
    memory: int | None,
) -> None:
    """Run a command line in a folder as the child, with faults in its system calls, and exit."""
    os.chdir(folder)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    for number, name in ((1, "out"), (2, "err")):
        handle = os.open(f"{output}.{name}", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(handle, number)
        os.close(handle)
    for name in signals:
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    if memory is not None:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + memory,) * 2)
        resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
    from support import fault_points

    for fault in faults:
        fault_points.plant(**fault)  # type: ignore[arg-type]
    from rlcli.cli.app import main

    sys.argv = ["rlcli", *arguments]
    sys.exit(main())


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    serve()

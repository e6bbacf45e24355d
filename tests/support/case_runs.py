"""Run drawn cases of a grammar one after another, and count their exit codes and the bad ones."""

import dataclasses
import os
import resource
import shutil
import signal
import time


@dataclasses.dataclass
class Ended:
    """Result of a function that has run in a child process."""

    text: str
    """What the function returned, or its exception."""
    wrong: str
    """Why the child did not end as it should; empty if it returned a text."""
    seconds: float
    """Processor time of the child."""
    memory: int
    """Largest resident memory of the child [bytes]."""


def in_child(function, seconds, memory):
    """Run `function` -> text in a forked child with limits of processor time [s] and memory [bytes]; return `Ended`.

    The address space may have twice the memory: libraries reserve memory that they do not use.
    """
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            signal.alarm(20 * seconds)  # other processes may use the cores
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
            resource.setrlimit(resource.RLIMIT_AS, (2 * memory, 2 * memory))
            text = function()
            code = 0
        except BaseException as error:
            text = f"{type(error).__name__}: {error}"
        os.write(writer, text.encode(errors="replace")[:60_000])
        os._exit(code)
    os.close(writer)
    with open(reader, "rb") as opened:
        text = opened.read().decode(errors="replace")
    _, status, used = os.wait4(child, 0)
    ended = Ended(text, "", used.ru_utime + used.ru_stime, used.ru_maxrss * 1024)
    if os.WIFSIGNALED(status):
        ended.wrong = signal.Signals(os.WTERMSIG(status)).name
    elif os.WEXITSTATUS(status):
        ended.wrong = "exception"
    elif ended.memory > memory:
        ended.wrong = f"{ended.memory >> 20} MB"
    elif ended.seconds > seconds:
        ended.wrong = f"{ended.seconds:.0f} s of processor time"
    return ended


def run_cases(run, first, count, folder=None):
    """Run `run(seed)` -> (exit code, what is wrong or "") for `count` seeds; print each bad case and the counts.

    `folder` is made empty before each case. Returns the number of bad cases.
    """
    codes, bad, slowest = {}, 0, 0.0
    for seed in range(first, first + count):
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
        begin = time.process_time()
        code, wrong = run(seed)
        slowest = max(slowest, time.process_time() - begin)
        codes[str(code)] = codes.get(str(code), 0) + 1
        bad += bool(wrong)
        if wrong:
            print(f"seed {seed}: {wrong}", flush=True)
    ends = ", ".join(f"exit {code}: {number}" for code, number in sorted(codes.items()))
    print(f"{count} cases from seed {first}: {ends}; {bad} bad; slowest {slowest:.1f} s of processor time", flush=True)
    return bad

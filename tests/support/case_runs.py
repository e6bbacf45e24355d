"""Run drawn cases of a grammar one after another, and count their exit codes and the bad ones."""

import dataclasses
import gc
import json
import os
import resource
import shutil
import signal
import time


@dataclasses.dataclass
class Ended:
    """Result of one case that has run in a child process."""

    text: str
    """What the case returned, or its exception."""
    wrong: str
    """Why the case did not end as it should; empty if it returned a text."""
    seconds: float
    """Processor time of the case."""
    memory: int
    """Largest resident memory of the child so far [bytes]."""


def in_children(function, cases, seconds, memory, batch=1):
    """Run `function(case)` -> text for each case in forked children with limits; yield (case, `Ended`).

    Args:
        function: the function.
        cases: its arguments.
        seconds: limit of processor time of one case [s].
        memory: limit of memory of one case [bytes]. The address space may have twice as much: libraries reserve memory
            that they do not use.
        batch: number of cases that one child runs one after another; the child also ends after a bad case.
    """
    cases = list(cases)
    gc.freeze()  # the collector of a child need not copy the parent's memory
    while cases:
        reader, writer = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(reader)
            _run_batch(function, cases[:batch], seconds, memory, writer)
        os.close(writer)
        begin, done, ended = 0.0, 0, None
        with open(reader, encoding="utf-8") as lines:
            for line in lines:
                ended = Ended(*json.loads(line))
                yield cases[done], ended
                done += 1
                begin += ended.seconds
        _, status, used = os.wait4(child, 0)
        if os.WIFSIGNALED(status):
            killed = Ended("", signal.Signals(os.WTERMSIG(status)).name, 0.0, used.ru_maxrss * 1024)
            killed.seconds = used.ru_utime + used.ru_stime - begin
            yield cases[done], killed
            done += 1
        del cases[:done]


def _run_batch(function, cases, seconds, memory, writer):
    """Run cases in this child process, and write a line for each; end the process."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_AS, (2 * memory, 2 * memory))
        for case in cases:
            signal.alarm(20 * seconds)  # other processes may use the cores
            begin = sum(os.times()[:4])
            resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time()) + seconds + 1, resource.RLIM_INFINITY))
            try:
                text, wrong = function(case), ""
            except BaseException as error:
                text, wrong = f"{type(error).__name__}: {error}", "exception"
            used = sum(os.times()[:4]) - begin
            peak = 1024 * max(
                resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
            )
            if peak > memory:
                wrong = wrong or f"{peak >> 20} MB"
            elif used > seconds:
                wrong = wrong or f"{used:.0f} s of processor time"
            line = json.dumps([text[:20_000], wrong, used, peak]) + "\n"
            for at in range(0, len(line), 4096):
                os.write(writer, line[at : at + 4096].encode())
            if wrong:
                break
    finally:
        os._exit(0)


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

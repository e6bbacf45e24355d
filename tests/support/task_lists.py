"""Runs of long lists of tasks: several at a time, with a file of results from which a run continues."""

import json
import os
import queue
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any


def results_of(function: Callable[..., Any], calls: Iterable[tuple[Any, ...]], threads: int) -> Iterator[Any]:
    """Call a function with each tuple of arguments in worker threads, and yield the results as the calls end.

    With several threads each is pinned to one core. Child processes of a thread inherit its core, so that libraries
    that start a thread for each core start one.
    """
    cores: queue.SimpleQueue[int] = queue.SimpleQueue()
    for core in range(threads):
        cores.put(core)

    def pin() -> None:
        if threads > 1:
            allowed = sorted(os.sched_getaffinity(0))
            os.sched_setaffinity(0, {allowed[cores.get() % len(allowed)]})

    with ThreadPoolExecutor(threads, initializer=pin) as pool:
        for future in as_completed([pool.submit(function, *call) for call in calls]):
            yield future.result()


def read_results(file: Path | None) -> list[dict[str, Any]]:
    """Return the results in a file of JSON lines; none without a file. A last line that was cut off is removed."""
    if file is None or not file.exists():
        return []
    text = file.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        file.write_text(whole, encoding="utf-8")
    return [json.loads(line) for line in whole.splitlines()]


def add_result(file: Path | None, result: dict[str, Any]) -> None:
    """Append a result to a file of JSON lines, if there is one."""
    if file is not None:
        with file.open("a", encoding="utf-8") as out:
            out.write(json.dumps(result) + "\n")

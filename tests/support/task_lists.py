"""Runs of long lists of tasks: several at a time, with a file of results from which a run continues."""

import json
import os
import queue
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import rlcli.errors


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


LONGEST = 600
"""Number of characters of a reason that a row keeps."""
_PLACE = re.compile(r"\.(py|ya?ml|toml|json):\d+|\[[^\]]+:\d+\]")
"""File and line of a message."""


def faulty_messages(reasons: Mapping[str, str]) -> list[str]:
    """Return the messages without file and line of the task, or that are errors of Python instead of errors of rlcli.

    An error of Python points at the task's code for something that rlcli lacks, unless the task itself is wrong: look
    at each. A module that cannot be found is missing in the task.

    Args:
        reasons: task -> why it stops, as `ERROR: MESSAGE` or `MESSAGE`, several messages with ` || ` between them.
    """
    ours = {"NameProblem", *(name for name, kind in vars(rlcli.errors).items() if isinstance(kind, type))}
    found = []
    for task, reason in sorted(reasons.items()):
        kind, _, text = reason.partition(": ") if re.match(r"\w+(Error|Problem): ", reason) else ("", "", reason)
        messages = text.split(" || ") if text else []
        if kind == "RuntimeError":  # the end of a training's log
            messages = re.findall(r"error: (.*)", text) or messages
        if len(text) >= LONGEST and len(messages) > 1:
            del messages[-1]  # it is cut off
        is_foreign = kind not in ("", "RuntimeError", "ModuleNotFoundError", *ours)
        wrong = [m for m in messages if is_foreign or not _PLACE.search(m) or "site-packages" in m]
        found += [f"{task}: {kind}: {message}" for message in wrong]
    return found

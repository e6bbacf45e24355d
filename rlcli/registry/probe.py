"""Details of tasks for `rlcli list-tasks`: read from a cache, or found out by loading tasks in other processes.

A distribution may ship the details as `index.json` in its top-level package, as the built-in tasks do. The details of
other tasks are in the user's cache folder, under the distribution's name and version, and the time of its last change.
"""

import contextlib
import functools
import json
import os
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any

from rlcli.machine.cores import available_cores
from rlcli.machine.memory import address_space, require_address_space
from rlcli.machine.processes import python_command
from rlcli.progress import Work, track
from rlcli.registry import OWN, TASKS, Entry, package_folder

TIMEOUT_S = 30.0
_IDLE_S = 3.0
"""Time in which a process has loaded no further plugin, after which it counts as hanging and frees its core [s]."""
_MAX_TIMEOUTS = 2
"""Number of entry points of one distribution that may exceed the time limit; all further ones are then skipped."""
_MAX_PROCESSES = 64
_SUFFIXES = (".py", ".yaml", ".xml")
_BUILDER = "rlcli.envs.describe_plugins"
"""Module that loads the tasks. It runs in a separate process because plugins may hang or crash, and because the layer
`envs` must not be imported from here."""


@dataclass(frozen=True, slots=True)
class Details:
    """Details of a task, as `list-tasks` shows them; None or an empty string means unknown."""

    summary: str = ""
    workflow: str | None = None
    observation_size: int | None = None
    action_size: int | None = None
    num_envs: int | None = None
    agent: str | None = None
    policy: bool = False
    """Whether a trained policy is shipped with the task."""
    broken: str | None = None
    """Why the task cannot be loaded; None: the task can be loaded, or has not been probed."""
    remedy: str | None = None
    """How the user provides the model that a broken task needs; None if nothing is missing."""

    @property
    def status(self) -> str:
        """`ok`, `ok, policy`, `broken: REASON`, or `?` if the task has not been probed."""
        if self.broken:
            return f"broken: {self.broken}"
        if self.workflow is None:
            return "?"
        return "ok, policy" if self.policy else "ok"

    def record(self) -> dict[str, Any]:
        """Return the details as JSON data."""
        return asdict(self)


_TYPES: dict[str, Any] = {
    **dict.fromkeys(("observation_size", "action_size", "num_envs"), int | None),
    **dict.fromkeys(("workflow", "agent", "broken", "remedy"), str | None),
    "summary": str,
    "policy": bool,
}
"""Types of the fields of `Details`. `_parse_details` checks them, because an import of pydantic would be slow."""


def cached_details(entries: Iterable[Entry]) -> dict[str, Details]:
    """Return the known details of tasks by qualified name; tasks without details are left out."""
    cache = _read_json(_cache_file())
    rows = {entry.qualified: _known_details(entry, cache) for entry in entries}
    return {name: row for name, row in rows.items() if row is not None}


def _known_details(entry: Entry, cache: dict[str, Any]) -> Details | None:
    folder = package_folder(entry)
    shipped = _parse_details(_read_json(folder / "index.json").get(entry.name)) if folder else None
    if entry.distribution == OWN:
        return shipped
    probed = _parse_details(cache.get(_key(entry)))
    if probed is not None and probed.broken:
        return probed  # the task is broken on this machine, whatever the plugin's own index contains
    return shipped or probed


def probe(
    entries: Iterable[Entry],
    timeout_s: float = TIMEOUT_S,
    group: str = TASKS,
    stop: threading.Event | None = None,
    without: Iterable[str] = (),
) -> dict[str, Details]:
    """Load plugins in other processes to find out whether they work; return their details by `Entry.qualified`.

    Details of tasks are also cached. For a broken entry point, `Details.broken` is the reason. The entry points of one
    distribution share a process. If one of them ends the process or exceeds the time limit, only this one is broken;
    the others continue in a new process. Several distributions are loaded at the same time.

    Args:
        entries: the entry points to load.
        timeout_s: time limit for one entry point [s].
        group: the entry-point group.
        stop: ends the probe early when it is set.
        without: environment variables that are removed for the processes.

    Raises:
        InterruptedError: if `stop` was set before the end.
        MachineError: if a limit such as `ulimit -v` leaves no room for torch.
    """
    require_address_space()
    entries = list(entries)
    owners: dict[str, list[Entry]] = {}
    for entry in entries:
        owners.setdefault(entry.distribution, []).append(entry)
    stop = stop or threading.Event()
    env = {name: value for name, value in os.environ.items() if name not in without}
    what = f"{group.partition('.')[2]} of plugins"
    with track(what, len(entries)) as work, ThreadPoolExecutor(_MAX_PROCESSES) as pool:
        try:  # Ctrl-C may come while `map` still starts threads, and the first process may already run then
            load = partial(_probe_distribution, timeout_s=timeout_s, group=group, stop=stop, env=env, work=work)
            rows = pool.map(load, owners.values())
            found = {name: row for part in rows for name, row in part.items()}
        except BaseException:  # Ctrl-C
            stop.set()
            raise
    if stop.is_set():
        raise InterruptedError("loading the plugins was stopped before its end; run the command again")
    if group == TASKS and address_space() is None:  # with a limit on the memory, a task may only seem broken
        _update_cache({_key(entry): found[entry.qualified].record() for entry in entries})
    return {entry.qualified: found[entry.qualified] for entry in entries}


def _update_cache(details: dict[str, Any]) -> None:
    file = _cache_file()
    with contextlib.suppress(OSError):  # without the cache `list-tasks` only shows fewer details
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary = file.with_suffix(f".{os.getpid()}.tmp")
        temporary.write_text(json.dumps({**_read_json(file), **details}, indent=1), encoding="utf-8")
        temporary.replace(file)


def _probe_distribution(
    entries: list[Entry], timeout_s: float, group: str, stop: threading.Event, env: dict[str, str], work: Work
) -> dict[str, Details]:
    """Load the entry points of one distribution; continue in a new process after a crash. Arguments as in `probe`."""
    found: dict[str, Details] = {}
    late = f"did not load within {timeout_s:g} s"
    while remaining := [entry.qualified for entry in entries if entry.qualified not in found]:
        if stop.is_set():
            break
        if sum(row.broken == late for row in found.values()) < _MAX_TIMEOUTS:
            rows = _probe_names(remaining, timeout_s, group, stop, env)
        else:
            rows = dict.fromkeys(remaining, Details(broken=f"not loaded, because {_MAX_TIMEOUTS} others {late}"))
        found.update(rows)
        work.advance(len(rows))
    return found


@functools.cache
def _cores() -> threading.Semaphore:
    """Return a semaphore with one unit for each core; a process that loads plugins holds one until it seems to hang."""
    return threading.Semaphore(available_cores())


def _probe_names(
    names: list[str], timeout_s: float, group: str, stop: threading.Event, env: dict[str, str]
) -> dict[str, Details]:
    """Load entry points, in this order, in one process; return the details of those that were tried, by name.

    If the process crashes or exceeds the time limit, the entry point at fault is the last one, marked as broken.
    """
    with (
        tempfile.TemporaryDirectory(prefix="rlcli-probe-", ignore_cleanup_errors=True) as folder,
        contextlib.ExitStack() as core,
    ):
        core.enter_context(_cores())
        file, log = Path(folder) / "rows", Path(folder) / "stderr"
        with log.open("wb") as stderr:
            process = subprocess.Popen(
                python_command("-m", _BUILDER, group, str(file), *names),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                env=env,
                start_new_session=True,
            )
        try:
            code = _wait(process, file, len(names), timeout_s, stop, core)
        finally:
            _kill(process)
        rows = _rows(file)
        lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    found = dict(zip(names, rows, strict=False))
    if len(found) == len(names):
        if code is None:
            last = found[names[-1]]
            reason = f"loaded, but its process did not end within {timeout_s:g} s (does a thread still run?)"
            found[names[-1]] = replace(last, broken=last.broken or reason)
        return found
    if code is None:
        reason = f"did not load within {timeout_s:g} s"
    elif code < 0:
        reason = f"crashed ({signal_name(-code)})"
    else:
        reason = f"ended the process (exit {code})"
    if code and lines and not lines[-1].startswith(" "):
        reason = f"{reason}: {lines[-1][:200]}"
    found[names[len(found)]] = Details(broken=reason)
    return found


def _wait(
    process: subprocess.Popen[bytes],
    file: Path,
    wanted: int,
    timeout_s: float,
    stop: threading.Event,
    core: contextlib.ExitStack,
) -> int | None:
    """Wait for the end of a process that loads plugins, and return its exit code.

    Return None if a plugin, or the end after the last one, takes longer than `timeout_s`, or if `stop` is set. If the
    process seems to hang, another process may use its core.

    Args:
        process: the process.
        file: the file to which the process appends a row for each plugin that it has loaded.
        wanted: number of plugins to load.
        timeout_s: time limit for one plugin [s].
        stop: ends the wait when it is set.
        core: holds the core that the process uses.
    """
    rows, deadline = 0, time.monotonic() + timeout_s
    while process.poll() is None:
        if rows < wanted and len(_rows(file)) > rows:
            rows, deadline = len(_rows(file)), time.monotonic() + timeout_s
        if time.monotonic() > deadline or stop.is_set():
            return None
        if time.monotonic() > deadline - timeout_s + _IDLE_S:
            core.close()
        time.sleep(0.02)
    return process.returncode


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill a process and the processes that it started."""
    with contextlib.suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
    process.wait()


def _rows(file: Path) -> list[Details]:
    """Return the details in a file with one JSON row for each loaded plugin, up to the first line that is not valid."""
    rows = []
    with contextlib.suppress(OSError, ValueError):
        for line in file.read_bytes().split(b"\n")[:-1]:  # the process may still be writing the last line
            row = _parse_details(json.loads(line))
            if row is None:
                break
            rows.append(row)
    return rows


def signal_name(number: int) -> str:
    """Return the name of a signal, such as SIGSEGV."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _key(entry: Entry) -> str:
    return f"{entry.qualified} {entry.version} {_last_change(entry)}"


def _last_change(entry: Entry) -> int:
    """Return the time [ns] of the last change: the installation of the distribution, or an edit of its package."""
    files = [file for suffix in _SUFFIXES for file in (package_folder(entry) or Path("/none")).rglob(f"*{suffix}")]
    with contextlib.suppress(metadata.PackageNotFoundError):
        files.append(Path(str(getattr(metadata.distribution(entry.distribution), "_path", ""))) / "RECORD")
    times = [0]
    for file in files:
        with contextlib.suppress(OSError):
            times.append(file.stat().st_mtime_ns)
    return max(times)


def _cache_file() -> Path:
    import platformdirs

    return Path(platformdirs.user_cache_dir("rlcli")) / "tasks.json"


def _read_json(file: Path) -> dict[str, Any]:
    """Return the mapping in a JSON file; an empty mapping if the file cannot be read or has another content."""
    try:
        value = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def _parse_details(row: object) -> Details | None:
    """Return the `Details` in a JSON value of an untrusted file; None if the value or a type is wrong."""
    if not isinstance(row, dict):
        return None
    known = {f.name: row[f.name] for f in fields(Details) if f.name in row}
    valid = all(isinstance(value, _TYPES[name]) for name, value in known.items())
    return Details(**known) if valid else None

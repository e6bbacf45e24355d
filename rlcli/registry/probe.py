"""What `list-tasks` knows of a task beyond its name, without importing it: a cache that `--probe` fills.

A distribution may ship it as `index.json` in its top-level package, as the built-in tasks do. The others' lies in the
user's cache folder, keyed by distribution, version and the state of its files.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields, replace
from importlib import metadata
from pathlib import Path
from typing import Any

from rlcli.machine import available_cores
from rlcli.registry import OWN, TASKS, Entry, package_folder

TIMEOUT_S = 30.0
_BUILDER = "rlcli.envs.task_index"
"""Run in a process of its own: it stands above this module, and it builds what may hang or crash."""


@dataclass(frozen=True, slots=True)
class Details:
    """What is known of a task; None and empty where nothing is."""

    summary: str = ""
    workflow: str | None = None
    observation_size: int | None = None
    action_size: int | None = None
    num_envs: int | None = None
    agent: str | None = None
    policy: bool = False
    """Whether a trained policy is shipped with it."""
    broken: str | None = None

    @property
    def status(self) -> str:
        """In a few words: `ok`, `ok, policy`, `broken: WHY`, or `?` where nobody has looked yet."""
        if self.broken:
            return f"broken: {self.broken}"
        if self.workflow is None:
            return "?"
        return "ok, policy" if self.policy else "ok"

    def record(self) -> dict[str, Any]:
        """As plain JSON."""
        return asdict(self)


_KINDS: dict[str, Any] = {
    **dict.fromkeys(("observation_size", "action_size", "num_envs"), int | None),
    **dict.fromkeys(("workflow", "agent", "broken"), str | None),
    "summary": str,
    "policy": bool,
}


def cached(entries: Iterable[Entry]) -> dict[str, Details]:
    """What is known already, by qualified name."""
    own = _raw(_cache_file())
    rows = {entry.qualified: _known(entry, own) for entry in entries}
    return {name: row for name, row in rows.items() if row is not None}


def _known(entry: Entry, own: dict[str, Any]) -> Details | None:
    shipped, probed = _details(_shipped(entry)), _details(own.get(_key(entry)))
    if entry.distribution != OWN and probed is not None and probed.broken:
        return probed  # its authors did not ship this
    return shipped or probed


def probe(
    entries: Iterable[Entry],
    timeout_s: float = TIMEOUT_S,
    group: str = TASKS,
    stop: threading.Event | None = None,
    without: Iterable[str] = (),
) -> dict[str, Details]:
    """Load every task in a process other than this one, and remember what it says. A broken one is a row with a reason.

    The tasks of a distribution share a process; who ends it, or takes longer than `timeout_s`, is alone to blame, and
    the others go on in a new one. Several distributions are loaded at a time. `stop` ends it early. `without` names
    variables of the environment that the processes are not to see.
    """
    entries = list(entries)
    owners: dict[str, list[Entry]] = {}
    for entry in entries:
        owners.setdefault(entry.distribution, []).append(entry)
    stop = stop or threading.Event()
    env = {name: value for name, value in os.environ.items() if name not in without}
    with ThreadPoolExecutor(max(1, min(len(owners), available_cores()))) as pool:
        try:  # around the start as well: the first process may run before the last thread does
            rows = pool.map(lambda owned: _probe_distribution(owned, timeout_s, group, stop, env), owners.values())
            found = {name: row for part in rows for name, row in part.items()}
        except BaseException:  # Ctrl-C
            stop.set()
            raise
    if stop.is_set():
        raise InterruptedError("the probe was ended before it was done")
    if group == TASKS:
        _remember({_key(entry): found[entry.qualified].record() for entry in entries})
    return {entry.qualified: found[entry.qualified] for entry in entries}


def _remember(known: dict[str, Any]) -> None:
    file = _cache_file()
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary = file.with_suffix(f".{os.getpid()}.tmp")
        temporary.write_text(json.dumps({**_raw(file), **known}, indent=1), encoding="utf-8")
        temporary.replace(file)
    except OSError:
        pass  # a cache that cannot be kept is only slower


def _probe_distribution(
    entries: list[Entry], timeout_s: float, group: str, stop: threading.Event, env: dict[str, str]
) -> dict[str, Details]:
    found: dict[str, Details] = {}
    while left := [entry.qualified for entry in entries if entry.qualified not in found]:
        if stop.is_set():
            break
        found.update(_probe_names(left, timeout_s, group, stop, env))
    return found


def _probe_names(
    names: list[str], timeout_s: float, group: str, stop: threading.Event, env: dict[str, str]
) -> dict[str, Details]:
    """What one process says of the first of these, and of as many more as it comes to."""
    with tempfile.TemporaryDirectory(prefix="rlcli-probe-", ignore_cleanup_errors=True) as folder:
        file, said = Path(folder) / "rows", Path(folder) / "stderr"
        with said.open("wb") as stderr:
            process = subprocess.Popen(
                [sys.executable, "-m", _BUILDER, group, str(file), *names],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                env=env,
                start_new_session=True,
            )
        try:
            code = _wait(process, file, len(names), timeout_s, stop)
        finally:
            _end(process)
        rows = _rows(file)
        lines = said.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    found = dict(zip(names, rows, strict=False))
    if len(found) == len(names):
        if code is None:
            reason = (
                f"loaded, but a process that loads it did not end within {timeout_s:g} s (does a thread still run?)"
            )
            found[names[-1]] = replace(found[names[-1]], broken=found[names[-1]].broken or reason)
        return found
    if code is None:
        reason = f"did not load within {timeout_s:g} s"
    elif code < 0:
        reason = f"crashed ({_signal(-code)})"
    else:
        reason = f"ended the process (exit {code})"
    if code and lines and not lines[-1].startswith(" "):
        reason = f"{reason}: {lines[-1][:200]}"
    found[names[len(found)]] = Details(broken=reason)
    return found


def _wait(
    process: subprocess.Popen[bytes], file: Path, wanted: int, timeout_s: float, stop: threading.Event
) -> int | None:
    """The exit code of a process that adds rows to a file; None if it took too long for one, or to end."""
    rows, deadline = 0, time.monotonic() + timeout_s
    while process.poll() is None:
        if rows < wanted and len(_rows(file)) > rows:
            rows, deadline = len(_rows(file)), time.monotonic() + timeout_s
        if time.monotonic() > deadline or stop.is_set():
            return None
        time.sleep(0.02)
    return process.returncode


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process and what it started."""
    with contextlib.suppress(OSError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
    process.wait()


def _rows(file: Path) -> list[Details]:
    """The complete lines of a file that are rows."""
    try:
        lines = file.read_bytes().split(b"\n")[:-1]
    except OSError:
        return []
    rows = []
    for line in lines:
        try:
            row = _details(json.loads(line))
        except ValueError:
            row = None
        if row is None:
            break
        rows.append(row)
    return rows


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _key(entry: Entry) -> str:
    return f"{entry.qualified} {entry.version} {_fingerprint(entry.distribution)}"


def _fingerprint(distribution: str) -> str:
    try:
        place = Path(str(getattr(metadata.distribution(distribution), "_path", "")))
        return str((place / "RECORD").stat().st_mtime_ns)
    except (OSError, metadata.PackageNotFoundError):
        return "0"


def _shipped(entry: Entry) -> Any:
    folder = package_folder(entry)
    return _raw(folder / "index.json").get(entry.name) if folder else None


def _cache_file() -> Path:
    import platformdirs

    return Path(platformdirs.user_cache_dir("rlcli")) / "tasks.json"


def _raw(file: Path) -> dict[str, Any]:
    try:
        value = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def _details(row: object) -> Details | None:
    """A row of a file that somebody else may have written; None if it is not one."""
    if not isinstance(row, dict):
        return None
    known = {f.name: row[f.name] for f in fields(Details) if f.name in row}
    good = all(isinstance(value, _KINDS[name]) for name, value in known.items())
    return Details(**known) if good else None

"""What `list-tasks` knows of a task beyond its name, without importing it: a cache that `--probe` fills.

A distribution may ship it as `index.json` in its top-level package, as the built-in tasks do. The others' lies in the
user's cache folder, keyed by distribution, version and the state of its files.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from importlib import metadata
from pathlib import Path
from typing import Any

from rlcli.registry import Entry, package_folder

TIMEOUT_S = 30.0
_BUILDER = "rlcli.envs.describe"
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
    broken: str | None = None

    def record(self) -> dict[str, Any]:
        """As plain JSON."""
        return asdict(self)


_KINDS: dict[str, Any] = {
    **dict.fromkeys(("observation_size", "action_size", "num_envs"), int | None),
    **dict.fromkeys(("workflow", "agent", "broken"), str | None),
    "summary": str,
}


def cached(entries: Iterable[Entry]) -> dict[str, Details]:
    """What is known already, by qualified name."""
    own = _raw(_cache_file())
    rows = {entry.qualified: _details(_shipped(entry) or own.get(_key(entry))) for entry in entries}
    return {name: row for name, row in rows.items() if row is not None}


def probe(entries: Iterable[Entry], timeout_s: float = TIMEOUT_S) -> dict[str, Details]:
    """Load every task in a process of its own, and remember what it says. A broken one is a row with its reason."""
    entries = list(entries)
    found = {entry.qualified: _probe_one(entry, timeout_s) for entry in entries}
    known = {_key(entry): found[entry.qualified].record() for entry in entries}
    file = _cache_file()
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary = file.with_suffix(f".{os.getpid()}.tmp")
        temporary.write_text(json.dumps({**_raw(file), **known}, indent=1), encoding="utf-8")
        temporary.replace(file)
    except OSError:
        pass  # a cache that cannot be kept is only slower
    return found


def _probe_one(entry: Entry, timeout_s: float) -> Details:
    command = [sys.executable, "-m", _BUILDER, entry.qualified]
    try:
        done = subprocess.run(command, capture_output=True, timeout=timeout_s, stdin=subprocess.DEVNULL)
    except subprocess.TimeoutExpired:
        return Details(broken=f"did not load within {timeout_s:g} s")
    try:
        row = _details(json.loads(done.stdout.splitlines()[-1]))
    except (IndexError, ValueError):
        row = None
    if row is not None and done.returncode == 0:
        return row
    lines = done.stderr.decode(errors="replace").strip().splitlines()
    reason = f"crashed (signal {-done.returncode})" if done.returncode < 0 else f"exit {done.returncode}"
    return Details(broken=f"{reason}: {lines[-1][:200]}" if lines else reason)


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
    except (OSError, ValueError):
        return {}
    return value if isinstance(value, dict) else {}


def _details(row: Any) -> Details | None:
    """A row of a file that somebody else may have written; None if it is not one."""
    if not isinstance(row, dict):
        return None
    known = {f.name: row[f.name] for f in fields(Details) if f.name in row}
    good = all(isinstance(value, _KINDS[name]) for name, value in known.items())
    return Details(**known) if good else None

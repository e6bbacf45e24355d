"""What `list-tasks` knows of a task beyond its name, without importing it: a cache that `--probe` fills.

The built-in tasks come with theirs (`tasks/rlcli_tasks/index.json`); other plugins' lie in the user's cache folder,
keyed by distribution, version and the state of its files.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from importlib import metadata
from pathlib import Path
from typing import Any

from rlcli.registry import Entry

TIMEOUT_S = 30.0
_BUILT_INS = "rlcli"


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


def cached(entries: Iterable[Entry]) -> dict[str, Details]:
    """What is known already, by qualified name."""
    shipped = _read(_shipped_file())
    own = _read(_cache_file())
    found = {}
    for entry in entries:
        row = shipped.get(entry.name) if entry.distribution == _BUILT_INS else own.get(_key(entry))
        if row is not None:
            found[entry.qualified] = row
    return found


def probe(entries: Iterable[Entry]) -> dict[str, Details]:
    """Load every task in a process of its own, and remember what it says. A broken one is a row with its reason."""
    entries = list(entries)
    found = {entry.qualified: _probe_one(entry) for entry in entries}
    known = {_key(entry): asdict(found[entry.qualified]) for entry in entries if entry.distribution != _BUILT_INS}
    file = _cache_file()
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary = file.with_suffix(".tmp")
        temporary.write_text(json.dumps({**_raw(file), **known}, indent=1), encoding="utf-8")
        temporary.replace(file)
    except OSError:
        pass  # a cache that cannot be kept is only slower
    return found


def describe(name: str) -> Details:
    """Load a task and build one environment of it; run in a process of its own by `probe`."""
    from rlcli.config.load import resolve
    from rlcli.envs.vec_env import make_env
    from rlcli.registry import find_task

    resolved = resolve(find_task(name))
    small = resolve(find_task(name), flags={"scene.num_envs": 1})
    env = make_env(small)
    return Details(
        summary=resolved.task.summary,
        workflow="direct" if resolved.source.task else "managed",
        observation_size=env.layout.size("policy"),
        action_size=env.layout.action_size,
        num_envs=resolved.task.scene.num_envs,
        agent=resolved.agent_name,
    )


def _probe_one(entry: Entry) -> Details:
    command = [sys.executable, "-m", "rlcli.probe", entry.qualified]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, stdin=subprocess.DEVNULL)
    except subprocess.TimeoutExpired:
        return Details(broken=f"did not load within {TIMEOUT_S:g} s")
    try:
        row = json.loads(done.stdout.splitlines()[-1])
        return Details(**row)
    except (IndexError, ValueError, TypeError):
        lines = done.stderr.strip().splitlines()
        reason = f"crashed ({-done.returncode})" if done.returncode < 0 else f"exit {done.returncode}"
        return Details(broken=lines[-1][:200] if lines else reason)


def _key(entry: Entry) -> str:
    return f"{entry.qualified} {entry.version} {_fingerprint(entry.distribution)}"


def _fingerprint(distribution: str) -> str:
    try:
        place = Path(str(getattr(metadata.distribution(distribution), "_path", "")))
        return str((place / "RECORD").stat().st_mtime_ns)
    except (OSError, metadata.PackageNotFoundError):
        return "0"


def _shipped_file() -> Path:
    import importlib.util

    found = importlib.util.find_spec("rlcli_tasks")
    place = next(iter(found.submodule_search_locations or [""])) if found else ""
    return Path(place) / "index.json"


def _cache_file() -> Path:
    import platformdirs

    return Path(platformdirs.user_cache_dir("rlcli")) / "tasks.json"


def _raw(file: Path) -> dict[str, Any]:
    try:
        value = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return value if isinstance(value, dict) else {}


def _read(file: Path) -> dict[str, Details]:
    names = {f.name for f in fields(Details)}
    return {
        key: Details(**{k: v for k, v in row.items() if k in names})
        for key, row in _raw(file).items()
        if isinstance(row, dict)
    }


def _main() -> None:
    from rlcli.errors import RlcliError

    try:
        details = describe(sys.argv[1])
    except RlcliError as error:
        details = Details(broken=" ".join(error.message.split())[:200])
    sys.stdout.write("\n" + json.dumps(asdict(details)) + "\n")


if __name__ == "__main__":
    _main()

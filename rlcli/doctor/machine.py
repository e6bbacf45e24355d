"""What the machine offers: cores, memory, a place for runs, an encoding."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from pathlib import Path

from rlcli.doctor.check import Check
from rlcli.machine import available_cores, core_quota, memory, memory_limit

LOW_DISK_BYTES = 1e9
LOW_MEMORY_BYTES = 1e9
"""torch and MuJoCo alone take about half of it."""


def machine_checks(runs_dir: Path) -> list[Check]:
    """Cores, memory, the runs folder, and how text is written."""
    return [_cores(), memory_check(memory(), memory_limit()), _runs_folder(runs_dir), _text()]


def memory_check(free: int, limit: int | None) -> Check:
    """Whether there is room to train.

    Args:
        free: bytes that a process may still ask for, as far as the system says.
        limit: bytes that a container grants; None: as many as there are.
    """
    details = {"available_bytes": free, "limit_bytes": limit}
    least = free if limit is None else min(free, limit)
    found = f"{free / 1e9:.1f} GB free" + (f", the control group grants {limit / 1e9:.1f} GB" if limit else "")
    if least >= LOW_MEMORY_BYTES:
        return Check("memory", "ok", found, details=details)
    hint = "end other programs" if limit is None or free < limit else "give the container more memory"
    return Check("memory", "warning", f"{found}: too little to train", f"{hint}, or set scene.num_envs lower", details)


def _cores() -> Check:
    cores, quota = available_cores(), core_quota()
    found = f"{cores} of {os.cpu_count()} for this process, the default of engine_threads"
    details = {"cores": os.cpu_count(), "available": cores, "quota": quota}
    if quota is not None:
        found += f"; its control group grants {quota:g}"
    return Check("cores", "ok", found, details=details)


def _runs_folder(folder: Path) -> Check:
    at = folder.absolute()
    while not at.exists() and at != at.parent:
        at = at.parent
    try:
        with tempfile.NamedTemporaryFile(dir=at):
            pass
        free = shutil.disk_usage(at).free
    except OSError as error:
        said = f"{folder} cannot be written: {at}: {error.strerror or error}"
        mend = "name another: --runs-dir, RLCLI_RUNS_DIR or runs_dir in the settings"
        return Check("runs folder", "broken", said, mend)
    found = f"{folder} can be written, {free / 1e9:.1f} GB free"
    state = "warning" if free < LOW_DISK_BYTES else "ok"
    hint = "make room, or name another: --runs-dir, RLCLI_RUNS_DIR" if state != "ok" else None
    return Check("runs folder", state, found, hint, {"free_bytes": free})


def _text() -> Check:
    """Encodings, and the terminal."""
    names = {"files": sys.getfilesystemencoding(), "output": getattr(sys.stdout, "encoding", None) or "none"}
    bad = {what: name for what, name in names.items() if name.lower().replace("-", "") not in ("utf8", "none")}
    width = shutil.get_terminal_size().columns
    terminal = sys.stdout is not None and sys.stdout.isatty()
    where = f"a terminal of {width} columns ({os.environ.get('TERM') or 'no TERM'})" if terminal else "no terminal"
    said = f"{where}, " + ", ".join(f"{what} {name}" for what, name in names.items())
    if not bad:
        return Check("text", "ok", said, details=dict(names))
    said = f"{said}: what it cannot write is shown as \\u...."
    return Check("text", "warning", said, "export PYTHONUTF8=1 PYTHONIOENCODING=utf-8", dict(names))

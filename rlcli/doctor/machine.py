"""Checks of the machine: cores, memory, the folder for runs, the encoding of text."""

import os
import shutil
import sys
import tempfile
from pathlib import Path

from rlcli.doctor.check import Check
from rlcli.machine import available_cores, available_memory, core_quota, memory_limit

LOW_DISK_BYTES = 1e9
LOW_MEMORY_BYTES = 1e9
"""Memory below which training gets a warning; torch and MuJoCo alone take about half of it."""


def machine_checks(runs_dir: Path) -> list[Check]:
    """Return the checks of cores, memory, the runs folder and the encoding of text."""
    return [_cores(), memory_check(available_memory(), memory_limit()), _runs_folder(runs_dir), _text()]


def memory_check(free: int, limit: int | None) -> Check:
    """Check that there is enough memory for training.

    Args:
        free: memory that the process may still allocate [bytes].
        limit: memory limit of the container [bytes]; None: no limit.
    """
    details = {"available_bytes": free, "limit_bytes": limit}
    least = free if limit is None else min(free, limit)
    found = f"{free / 1e9:.1f} GB free" + (f", the control group allows {limit / 1e9:.1f} GB" if limit else "")
    if least >= LOW_MEMORY_BYTES:
        return Check("memory", "ok", found, details=details)
    hint = "end other programs" if limit is None or free < limit else "give the container more memory"
    return Check("memory", "warning", f"{found}: too little to train", f"{hint}, or set scene.num_envs lower", details)


def _cores() -> Check:
    """Report the cores of this process."""
    cores, quota = available_cores(), core_quota()
    found = f"{cores} of {os.cpu_count()} cores for this process; engine_threads defaults to {cores}"
    details = {"cores": os.cpu_count(), "available": cores, "quota": quota}
    if quota is not None:
        found += f"; its control group allows {quota:g}"
    return Check("cores", "ok", found, details=details)


def _runs_folder(folder: Path) -> Check:
    """Check that the runs folder, or the nearest existing folder above it, is writable and has free space."""
    existing = folder.absolute()
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    try:
        with tempfile.NamedTemporaryFile(dir=existing):
            pass
        free = shutil.disk_usage(existing).free
    except OSError as error:
        text = f"{folder} is not writable: {existing}: {error.strerror or error}"
        hint = "choose another folder: --runs-dir, RLCLI_RUNS_DIR or runs_dir in the settings"
        return Check("runs folder", "broken", text, hint)
    found, details = f"{folder} is writable, {free / 1e9:.1f} GB free", {"free_bytes": free}
    if free >= LOW_DISK_BYTES:
        return Check("runs folder", "ok", found, details=details)
    return Check("runs folder", "warning", found, "free some space, or choose another folder: --runs-dir", details)


def _text() -> Check:
    """Check the encodings of file names and of the output, and describe the terminal."""
    encodings = {"files": sys.getfilesystemencoding(), "output": getattr(sys.stdout, "encoding", None) or "none"}
    width = shutil.get_terminal_size().columns
    terminal = sys.stdout is not None and sys.stdout.isatty()
    where = f"a terminal of {width} columns ({os.environ.get('TERM') or 'no TERM'})" if terminal else "no terminal"
    text = f"{where}, " + ", ".join(f"{what} {name}" for what, name in encodings.items())
    if all(name.lower().replace("-", "") in ("utf8", "none") for name in encodings.values()):
        return Check("text", "ok", text, details=dict(encodings))
    text = f"{text}: characters that this encoding lacks are printed as \\u...."
    return Check("text", "warning", text, "export PYTHONUTF8=1 PYTHONIOENCODING=utf-8", dict(encodings))

"""Checks of the machine (cores, memory, folders, text encoding), of the settings file and of environment variables."""

import os
import shutil
import sys
import tempfile
from pathlib import Path

from rlcli.config.user_settings import read_settings
from rlcli.doctor.check import Check
from rlcli.errors import ConfigError
from rlcli.machine.control_groups import core_quota
from rlcli.machine.cores import available_cores
from rlcli.machine.memory import available_memory, memory_limit
from rlcli.registry import plugins_chosen_by, unknown_wanted
from rlcli.settings import settings_file

VARIABLES = (
    *("RLCLI_SETTINGS", "RLCLI_RUNS_DIR", "RLCLI_PLUGINS", "RLCLI_MODELS", "RLCLI_STATE_DIR"),
    *("MUJOCO_GL", "DISPLAY", "CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OMP_THREAD_LIMIT"),
    *("OMP_WAIT_POLICY", "KMP_BLOCKTIME", "LOCAL_WORLD_SIZE", "PYTHONPATH", "NO_COLOR", "FORCE_COLOR"),
)
"""Environment variables that `rlcli doctor` lists, if they are set."""
LOW_DISK_BYTES = 1e9
LOW_MEMORY_BYTES = 1e9
"""Memory [bytes] below which the check warns about training; torch and MuJoCo alone take about half of it."""


def machine_checks(runs_dir: Path) -> list[Check]:
    """Return the checks of cores, memory, the runs folder (where trainings are written) and the encoding of text."""
    return [_core_check(), memory_check(available_memory(), memory_limit()), _runs_folder(runs_dir), _encodings()]


def memory_check(free: int, limit: int | None) -> Check:
    """Check that there is enough memory for training.

    Args:
        free: memory of the machine that is still available [bytes].
        limit: memory limit of the process or its container [bytes]; None: no limit.
    """
    details = {"available_bytes": free, "limit_bytes": limit}
    least = free if limit is None else min(free, limit)
    found = f"{free / 1e9:.1f} GB free" + (f", this process may use {limit / 1e9:.1f} GB" if limit else "")
    if least >= LOW_MEMORY_BYTES:
        return Check("memory", "ok", found, details=details)
    hint = "end other programs" if limit is None or free < limit else "raise the limit (container, `ulimit -v`)"
    return Check("memory", "warning", f"{found}: too little to train", f"{hint}, or set scene.num_envs lower", details)


def _core_check() -> Check:
    """Report how many cores this process may use."""
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


def _encodings() -> Check:
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


def settings_checks() -> list[Check]:
    """Return the checks of the settings file and of the environment variables."""
    return [_settings_file(), _variables_check()]


def _settings_file() -> Check:
    """Check that the user's settings file is valid."""
    file = settings_file()
    if file is None:
        return Check("settings", "ok", "no file is read, because RLCLI_SETTINGS is none", details={"file": None})
    try:
        found = read_settings()
    except ConfigError as error:
        hint = f"edit {file}, or set RLCLI_SETTINGS=none to ignore it"
        return Check("settings", "broken", "; ".join(map(str, error.problems)), hint, {"file": str(file)})
    text = ", ".join(f"{key}: {value}" for key, value in found.items()) or "sets nothing"
    text = f"{file}: {text}" if file.exists() else f"no settings file; it would be {file}"
    return Check("settings", "ok", text, details={"file": str(file), "settings": found})


def _variables_check() -> Check:
    """Check that no environment variable names a missing plugin or slows training down."""
    variables = {name: os.environ[name] for name in VARIABLES if name in os.environ}
    texts = [", ".join(f"{name}={value}" for name, value in variables.items()) or "none"]
    hints = []
    if unknown := unknown_wanted():
        texts.append(f"{plugins_chosen_by()} names distributions that are not installed: {unknown}")
        hints.append("write the names of distributions, as list-tasks prints them")
    for name, reason in harmful_variables(variables, available_cores()).items():
        texts.append(f"{name}: {reason}")
        hints.append(f"unset {name}")
    return Check("variables", "warning" if hints else "ok", "; ".join(texts), "; ".join(hints) or None, variables)


def harmful_variables(variables: dict[str, str], cores: int) -> dict[str, str]:
    """Return the environment variables whose values make training slower, as a mapping from name to reason.

    Args:
        variables: name -> value of environment variables.
        cores: number of cores that this process may use.
    """
    found = {}
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        if variables.get(name, "").isdecimal() and int(variables[name]) > cores:
            found[name] = f"more threads than the {cores} cores of this process"
    limit = variables.get("OMP_THREAD_LIMIT", "")
    if limit.isdecimal() and int(limit) < min(4, cores):
        found["OMP_THREAD_LIMIT"] = "fewer threads than the default of agent.torch_threads"
    for name, spinning in (("OMP_WAIT_POLICY", "active"), ("KMP_BLOCKTIME", "infinite")):
        if variables.get(name, "").strip().lower() == spinning:
            found[name] = "waiting OpenMP threads occupy cores that the engine needs"
    if variables.get("LOCAL_WORLD_SIZE", "1") not in ("", "1"):
        found["LOCAL_WORLD_SIZE"] = "rlcli divides the cores by this number, which launchers of several processes set"
    return found

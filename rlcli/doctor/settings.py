"""Checks of the user's settings file and of environment variables."""

import os

from rlcli.config.settings_file import read_settings
from rlcli.doctor.check import Check
from rlcli.errors import ConfigError
from rlcli.machine import available_cores
from rlcli.registry import plugins_chosen_by, unknown_wanted
from rlcli.settings import settings_file

VARIABLES = (
    *("RLCLI_SETTINGS", "RLCLI_RUNS_DIR", "RLCLI_PLUGINS", "RLCLI_MODELS", "RLCLI_STATE_DIR"),
    *("MUJOCO_GL", "DISPLAY", "CUDA_VISIBLE_DEVICES", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OMP_THREAD_LIMIT"),
    *("OMP_WAIT_POLICY", "KMP_BLOCKTIME", "LOCAL_WORLD_SIZE", "PYTHONPATH", "NO_COLOR", "FORCE_COLOR"),
)
"""Environment variables that the check lists."""


def settings_checks() -> list[Check]:
    """Return the checks of the settings file and of the environment variables."""
    return [_file(), _variables()]


def _file() -> Check:
    """Check that the settings file is valid."""
    file = settings_file()
    if file is None:
        return Check("settings", "ok", "not read, because of RLCLI_SETTINGS=none", details={"file": None})
    try:
        found = read_settings()
    except ConfigError as error:
        hint = f"edit {file}, or set RLCLI_SETTINGS=none to ignore it"
        return Check("settings", "broken", "; ".join(map(str, error.problems)), hint, {"file": str(file)})
    text = ", ".join(f"{key}: {value}" for key, value in found.items()) or "sets nothing"
    text = f"{file}: {text}" if file.exists() else f"none; the file would be {file}"
    return Check("settings", "ok", text, details={"file": str(file), "settings": found})


def _variables() -> Check:
    """Check that no environment variable names a missing plugin or slows training down."""
    variables = {name: os.environ[name] for name in VARIABLES if name in os.environ}
    texts = [", ".join(f"{name}={value}" for name, value in variables.items()) or "none"]
    hints = []
    if unknown := unknown_wanted():
        texts.append(f"{plugins_chosen_by()} names distributions that are not installed: {', '.join(unknown)}")
        hints.append("write the names of distributions, as list-tasks prints them")
    for name, reason in harmful_variables(variables, available_cores()).items():
        texts.append(f"{name}: {reason}")
        hints.append(f"unset {name}")
    return Check("variables", "warning" if hints else "ok", "; ".join(texts), "; ".join(hints) or None, variables)


def harmful_variables(variables: dict[str, str], cores: int) -> dict[str, str]:
    """Return the environment variables that make training slower, each with the reason."""
    found = {}
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        if variables.get(name, "").isdecimal() and int(variables[name]) > cores:
            found[name] = f"more threads than the {cores} cores of this process"
    limit = variables.get("OMP_THREAD_LIMIT", "")
    if limit.isdecimal() and int(limit) < min(4, cores):
        found["OMP_THREAD_LIMIT"] = "fewer threads than the default of agent.torch_threads"
    for name, spinning in (("OMP_WAIT_POLICY", "active"), ("KMP_BLOCKTIME", "infinite")):
        if variables.get(name, "").strip().lower() == spinning:
            found[name] = "waiting OpenMP threads occupy cores that the engine needs; unset it"
    if variables.get("LOCAL_WORLD_SIZE", "1") not in ("", "1"):
        found["LOCAL_WORLD_SIZE"] = "the cores are divided by this number, as a launcher of several processes needs it"
    return found

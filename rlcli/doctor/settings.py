"""What the user has set: the settings file, and environment variables."""

from __future__ import annotations

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
"""Environment variables that are shown."""


def settings_checks() -> list[Check]:
    """The user's settings file and the variables of the environment."""
    return [_file(), _variables()]


def _file() -> Check:
    file = settings_file()
    if file is None:
        return Check("settings", "ok", "left out by RLCLI_SETTINGS=none", details={"file": None})
    try:
        found = read_settings()
    except ConfigError as error:
        mend = f"edit {file}; until then RLCLI_SETTINGS=none leaves it out"
        return Check("settings", "broken", "; ".join(map(str, error.problems)), mend, {"file": str(file)})
    said = ", ".join(f"{key}: {value}" for key, value in found.items()) or "sets nothing"
    said = f"{file}: {said}" if file.exists() else f"none; they would be read from {file}"
    return Check("settings", "ok", said, details={"file": str(file), "settings": found})


def _variables() -> Check:
    given = {name: os.environ[name] for name in VARIABLES if name in os.environ}
    said = [", ".join(f"{name}={value}" for name, value in given.items()) or "none"]
    hints = []
    if unknown := unknown_wanted():
        said.append(f"{plugins_chosen_by()} names what is not installed: {', '.join(unknown)}")
        hints.append("name distributions, as list-tasks does")
    for name, why in harmful_variables(given, available_cores()).items():
        said.append(f"{name}: {why}")
        hints.append(f"unset {name}")
    return Check("variables", "warning" if hints else "ok", "; ".join(said), "; ".join(hints) or None, given)


def harmful_variables(given: dict[str, str], cores: int) -> dict[str, str]:
    """Variables that make training slower -> how."""
    found = {}
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        if given.get(name, "").isdecimal() and int(given[name]) > cores:
            found[name] = f"more threads than the {cores} cores of this process"
    limit = given.get("OMP_THREAD_LIMIT", "")
    if limit.isdecimal() and int(limit) < min(4, cores):
        found["OMP_THREAD_LIMIT"] = "fewer threads than agent.torch_threads asks for"
    for name, spinning in (("OMP_WAIT_POLICY", "active"), ("KMP_BLOCKTIME", "infinite")):
        if given.get(name, "").strip().lower() == spinning:
            found[name] = "threads that wait keep the engine's from their cores"
    if given.get("LOCAL_WORLD_SIZE", "1") not in ("", "1"):
        found["LOCAL_WORLD_SIZE"] = "the cores are divided by it, as a launcher of several processes asks for"
    return found

"""The version of Isaac Sim that task files see, and a function that compares versions.

A task of Isaac Lab that imports a name from `isaaclab.utils.version` gets the object of this name from here.
"""

from __future__ import annotations

import re
from typing import Any

_ISAAC_SIM = ("5.1.0", "", "5", "1", "0", "", "", "")
"""Version of Isaac Sim for which Isaac Lab 2.3.2 was written, in the form that `get_version` returns."""


def get_version() -> tuple[str, ...]:
    """Return the version of Isaac Sim in eight strings, as `isaacsim.core.version.get_version` does.

    They are the version, the pre-release, major, minor and patch number, and three about the build.
    """
    return _ISAAC_SIM


def get_isaac_sim_version() -> Any:
    """Return the version of Isaac Sim as a `packaging.version.Version`."""
    from packaging.version import (
        Version,
    )  # not a dependency of the plugin: a task file that asks for this also imports it

    return Version(_ISAAC_SIM[0])


def compare_versions(v1: str, v2: str) -> int:
    """Return 1 if the first version is newer, -1 if it is older, 0 if both are equal."""
    first, second = ([int(number) for number in re.findall(r"\d+", text)] for text in (v1, v2))
    return (first > second) - (first < second)

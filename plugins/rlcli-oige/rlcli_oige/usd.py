"""Names of USD and Omniverse that task files import and, with MJCF models, do not need."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Any

from rlcli.errors import TaskError

_LOG = logging.getLogger("rlcli_oige")


@dataclass
class ArticulationAction:
    """Targets and efforts of a robot's joints, for `apply_action`."""

    joint_positions: Any = None
    joint_velocities: Any = None
    joint_efforts: Any = None
    joint_indices: Any = None


class _Absent:
    """A module that may be imported; what a task asks of it is refused by name."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise TaskError(
            f"{self._name}.{name} edits a USD stage, and there is none",
            hint="models are MJCF files here: make the change there, or in the spec of the scene",
        )


class _Carb:
    """Omniverse's logger."""

    def log_error(self, message: str) -> None:
        """To Python's log."""
        _LOG.error(message)

    def log_warn(self, message: str) -> None:
        """To Python's log."""
        _LOG.warning(message)

    def log_info(self, message: str) -> None:
        """To Python's log."""
        _LOG.info(message)


carb = _Carb()
omni = _Absent("omni")
Gf, PhysxSchema, Sdf, Usd = _Absent("Gf"), _Absent("PhysxSchema"), _Absent("Sdf"), _Absent("Usd")
UsdGeom, UsdLux, UsdPhysics = _Absent("UsdGeom"), _Absent("UsdLux"), _Absent("UsdPhysics")

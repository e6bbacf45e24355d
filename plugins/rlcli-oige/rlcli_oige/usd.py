"""Names of USD and Omniverse that task files import. Tasks with MJCF models do not need them."""

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


class _MissingModule:
    """Placeholder for a module: importing it works, using one of its names raises an error."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise TaskError(
            f"{self._name}.{name} edits a USD stage, but there is none",
            hint="make the change in the MJCF file instead, or in the spec of the scene",
        )


class _Carb:
    """Omniverse's logger, which writes to Python's logging."""

    def log_error(self, message: str) -> None:
        """Log an error."""
        _LOG.error(message)

    def log_warn(self, message: str) -> None:
        """Log a warning."""
        _LOG.warning(message)

    def log_info(self, message: str) -> None:
        """Log a message."""
        _LOG.info(message)


carb = _Carb()
omni = _MissingModule("omni")
Gf, PhysxSchema = _MissingModule("Gf"), _MissingModule("PhysxSchema")
Sdf, Usd = _MissingModule("Sdf"), _MissingModule("Usd")
UsdGeom, UsdLux, UsdPhysics = _MissingModule("UsdGeom"), _MissingModule("UsdLux"), _MissingModule("UsdPhysics")

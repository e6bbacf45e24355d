"""`ArticulationActions`, the joint targets that actuator models receive and return.

A task of Isaac Lab that imports a name from `isaaclab.utils.types` gets the object of this name from here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor


@dataclass
class ArticulationActions:
    """Targets that an action sets for joints: positions, velocities and efforts. (num_envs, joints) each"""

    joint_positions: Tensor | None = None
    joint_velocities: Tensor | None = None
    joint_efforts: Tensor | None = None
    joint_indices: Any = None

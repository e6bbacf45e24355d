"""Types of Isaac Lab's utilities. Names as in `isaaclab.utils.types`."""

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

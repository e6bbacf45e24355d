"""Where rays start and go. Names as in `isaaclab.sensors.patterns`."""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.config_class import MISSING, configclass


@configclass
class GridPatternCfg:
    """Parallel rays from a grid."""

    func: Any = "grid_pattern"
    resolution: float = MISSING
    size: Any = MISSING
    direction: Any = (0.0, 0.0, -1.0)
    ordering: str = "xy"

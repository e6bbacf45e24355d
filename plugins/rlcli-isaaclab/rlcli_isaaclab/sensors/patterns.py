"""Start points and directions of rays. Names as in `isaaclab.sensors.patterns`."""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.config_class import MISSING, configclass


@configclass
class GridPatternCfg:
    """Parallel rays that start on a grid."""

    func: Any = "grid_pattern"
    resolution: float = MISSING
    size: Any = MISSING
    direction: Any = (0.0, 0.0, -1.0)
    ordering: str = "xy"

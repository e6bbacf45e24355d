"""Configuration of differential inverse kinematics; a replacement for Pink's. Names as in `isaaclab.controllers`."""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.config_class import MISSING, configclass
from rlcli_isaaclab.operational_space import OperationalSpaceController


@configclass
class DifferentialIKControllerCfg:
    """Differential inverse kinematics; rlcli always uses damped least squares."""

    class_type: Any = "DifferentialIKController"
    command_type: str = MISSING
    use_relative_mode: bool = False
    ik_method: str = "dls"
    ik_params: Any = None


def convert_usd_to_urdf(usd_path: str, output_path: str, force_conversion: bool = True) -> tuple[str, str]:
    """Return the paths that Isaac Lab would write, and write nothing: only Pink reads them, which rlcli refuses."""
    return f"{output_path}/urdf", f"{output_path}/meshes"


__all__ = ["DifferentialIKControllerCfg", "OperationalSpaceController", "convert_usd_to_urdf"]

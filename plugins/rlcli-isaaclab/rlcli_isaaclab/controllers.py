"""Configuration of differential inverse kinematics, and a stand-in for a function of Pink (another IK library).

A task of Isaac Lab that imports a name from `isaaclab.controllers` gets the object of this name from here.
"""

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
    """Return the paths that Isaac Lab would write, without writing: only Pink, which rlcli lacks, reads the files."""
    return f"{output_path}/urdf", f"{output_path}/meshes"


__all__ = ["DifferentialIKControllerCfg", "OperationalSpaceController", "convert_usd_to_urdf"]

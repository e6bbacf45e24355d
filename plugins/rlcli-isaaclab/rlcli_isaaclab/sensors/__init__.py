"""Sensors, their configuration classes, and patterns of rays.

A task of Isaac Lab that imports a name from `isaaclab.sensors` gets the object of this name from here.
"""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.config_class import MISSING, configclass
from rlcli_isaaclab.sensor_facade import Sensor as ContactSensor
from rlcli_isaaclab.sensor_facade import Sensor as RayCaster
from rlcli_isaaclab.sensors import patterns


@configclass
class SensorBaseCfg:
    """Settings that every sensor has."""

    class_type: Any = "SensorBase"
    prim_path: str = MISSING
    update_period: float = 0.0
    history_length: int = 0
    debug_vis: bool = False


@configclass
class ContactSensorCfg(SensorBaseCfg):
    """Settings of a sensor of the contact forces on bodies."""

    class_type: Any = "ContactSensor"
    track_pose: bool = False
    track_contact_points: bool = False
    track_friction_forces: bool = False
    track_air_time: bool = False
    force_threshold: float = 1.0
    filter_prim_paths_expr: Any = []  # noqa: RUF012  (configclass copies it for each object)
    max_contact_data_count_per_prim: int = 4
    visualizer_cfg: Any = None


@configclass
class RayCasterCfg(SensorBaseCfg):
    """Settings of a sensor of distances along rays, such as a height scan or a lidar."""

    @configclass
    class OffsetCfg:
        """Sensor pose in the frame of its body."""

        pos: Any = (0.0, 0.0, 0.0)
        rot: Any = (1.0, 0.0, 0.0, 0.0)

    class_type: Any = "RayCaster"
    mesh_prim_paths: Any = MISSING
    offset: Any = OffsetCfg()
    attach_yaw_only: Any = None
    ray_alignment: str = "base"
    pattern_cfg: Any = MISSING
    max_distance: float = 1e6
    drift_range: Any = (0.0, 0.0)
    ray_cast_drift_range: Any = None
    visualizer_cfg: Any = None


@configclass
class ImuCfg(SensorBaseCfg):
    """Settings of an IMU. rlcli ignores them: an MJCF has sensors of its own for angular velocity and acceleration."""

    class_type: Any = "Imu"
    offset: Any = None
    visualizer_cfg: Any = None
    gravity_bias: Any = (0.0, 0.0, 9.81)


__all__ = [
    "ContactSensor",
    "ContactSensorCfg",
    "ImuCfg",
    "RayCaster",
    "RayCasterCfg",
    "SensorBaseCfg",
    "patterns",
]

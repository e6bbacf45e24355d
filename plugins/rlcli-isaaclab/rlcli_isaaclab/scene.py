"""Configuration class of the scene.

A task of Isaac Lab that imports a name from `isaaclab.scene` gets the object of this name from here.
"""

from __future__ import annotations

from rlcli_isaaclab.config_class import MISSING, configclass


@configclass
class InteractiveSceneCfg:
    """Settings of the scene of each environment; a task adds members for assets, sensors and lights."""

    num_envs: int = MISSING
    env_spacing: float = MISSING
    lazy_sensor_update: bool = True
    replicate_physics: bool = True
    filter_collisions: bool = True
    clone_in_fabric: bool = False

"""Configuration classes of robots and objects.

A task of Isaac Lab that imports a name from `isaaclab.assets` or `isaaclab_assets` gets the object from here.
"""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.actuators import ImplicitActuatorCfg
from rlcli_isaaclab.config_class import MISSING, configclass
from rlcli_isaaclab.model_lookup import USD_TO_MJCF, map_usd
from rlcli_isaaclab.scene_facade import Asset as Articulation
from rlcli_isaaclab.scene_facade import Asset as RigidObject
from rlcli_isaaclab.sim import UsdFileCfg
from rlcli_isaaclab.utils.assets import ISAAC_NUCLEUS_DIR, ISAACLAB_NUCLEUS_DIR


@configclass
class AssetBaseCfg:
    """Configuration of an asset of the scene."""

    @configclass
    class InitialStateCfg:
        """Initial position [m] and quaternion (w, x, y, z)."""

        pos: Any = (0.0, 0.0, 0.0)
        rot: Any = (1.0, 0.0, 0.0, 0.0)

    class_type: Any = None
    prim_path: str = MISSING
    spawn: Any = None
    init_state: Any = InitialStateCfg()
    collision_group: int = 0
    debug_vis: bool = False


@configclass
class RigidObjectCfg(AssetBaseCfg):
    """Configuration of a free rigid body."""

    @configclass
    class InitialStateCfg(AssetBaseCfg.InitialStateCfg):
        """Initial pose and velocity [m, m/s, rad/s]."""

        lin_vel: Any = (0.0, 0.0, 0.0)
        ang_vel: Any = (0.0, 0.0, 0.0)

    class_type: Any = "RigidObject"
    init_state: Any = InitialStateCfg()


@configclass
class ArticulationCfg(AssetBaseCfg):
    """Configuration of a robot or another asset with joints and actuators."""

    @configclass
    class InitialStateCfg(RigidObjectCfg.InitialStateCfg):
        """Initial pose and velocity of the root and the joints."""

        joint_pos: Any = {".*": 0.0}  # noqa: RUF012  (configclass copies it for each object)
        joint_vel: Any = {".*": 0.0}  # noqa: RUF012

    class_type: Any = "Articulation"
    articulation_root_prim_path: Any = None
    init_state: Any = InitialStateCfg()
    soft_joint_pos_limit_factor: float = 1.0
    actuators: Any = MISSING
    actuator_value_resolution_debug_print: bool = False


CARTPOLE_CFG = ArticulationCfg(
    spawn=UsdFileCfg(usd_path=f"{ISAACLAB_NUCLEUS_DIR}/Robots/Classic/Cartpole/cartpole.usd"),
    init_state=ArticulationCfg.InitialStateCfg(
        pos=(0.0, 0.0, 2.0), joint_pos={"slider_to_cart": 0.0, "cart_to_pole": 0.0}
    ),
    actuators={
        "cart_actuator": ImplicitActuatorCfg(
            joint_names_expr=["slider_to_cart"], effort_limit_sim=400.0, stiffness=0.0, damping=10.0
        ),
        "pole_actuator": ImplicitActuatorCfg(
            joint_names_expr=["cart_to_pole"], effort_limit_sim=400.0, stiffness=0.0, damping=0.0
        ),
    },
)
"""A cart with a pole."""

ANT_CFG = ArticulationCfg(
    spawn=UsdFileCfg(usd_path=f"{ISAAC_NUCLEUS_DIR}/Robots/Ant/ant_instanceable.usd"),
    init_state=ArticulationCfg.InitialStateCfg(pos=(0.0, 0.0, 0.5)),
    actuators={"body": ImplicitActuatorCfg(joint_names_expr=[".*"], stiffness=0.0, damping=0.0)},
)
"""A robot with four legs."""

__all__ = [
    "ANT_CFG",
    "CARTPOLE_CFG",
    "USD_TO_MJCF",
    "Articulation",
    "ArticulationCfg",
    "AssetBaseCfg",
    "RigidObject",
    "RigidObjectCfg",
    "map_usd",
]

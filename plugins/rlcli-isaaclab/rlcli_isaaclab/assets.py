"""Configuration classes of robots and objects, and the MJCF that replaces each USD file.

Names as in `isaaclab.assets` and `isaaclab_assets`.
"""

from __future__ import annotations

from typing import Any

from rlcli.errors import TaskError, did_you_mean, listing
from rlcli_isaaclab.actuators import ImplicitActuatorCfg
from rlcli_isaaclab.config_class import MISSING, configclass
from rlcli_isaaclab.scene_facade import Asset as Articulation
from rlcli_isaaclab.scene_facade import Asset as RigidObject
from rlcli_isaaclab.sim import UsdFileCfg
from rlcli_isaaclab.utils.assets import ISAAC_NUCLEUS_DIR, ISAACLAB_NUCLEUS_DIR

USD_TO_MJCF: dict[str, str] = {
    "Robots/Classic/Cartpole/cartpole.usd": "cartpole:cartpole.xml",
    "Robots/Cartpole/cartpole.usd": "cartpole:cartpole.xml",
    "Robots/IsaacSim/Ant/ant_instanceable.usd": "ant-direct:ant.xml",
    "Robots/Ant/ant_instanceable.usd": "ant-direct:ant.xml",
}
"""End of a USD path -> MJCF: a file relative to the task's folder, or `TASK:FILE` of an installed task."""


def map_usd(usd: str, mjcf: str) -> None:
    """Replace a USD file by an MJCF; the end of the USD's path is enough. Call it before creating the configuration."""
    USD_TO_MJCF[usd] = mjcf


def mjcf_of(usd: str) -> str:
    """Return the MJCF that replaces a USD file; an `.xml` file is returned unchanged.

    Raises:
        TaskError: if no MJCF is known for it.
    """
    if usd.endswith(".xml"):
        return usd
    for end, mjcf in USD_TO_MJCF.items():
        if usd.replace("\\", "/").endswith(end):
            return mjcf
    near = did_you_mean(usd.rsplit("/", 1)[-1], [end.rsplit("/", 1)[-1] for end in USD_TO_MJCF])
    known = f"known: {listing(USD_TO_MJCF)}"
    raise TaskError(
        f"no MJCF model is known for the USD file '{usd}'",
        hint=f"rlcli_isaaclab.assets.map_usd('{'/'.join(usd.split('/')[-2:])}', 'model.xml') sets it;"
        f" {near + ' ' if near else ''}{known}",
    )


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
    """Configuration of a robot."""

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
    "mjcf_of",
]

# ruff: noqa: F401
"""All names of OmniIsaacGymEnvs' vocabulary that `rlcli_oige` defines."""

from rlcli_oige.articulation_view import ArticulationView
from rlcli_oige.maths import *  # noqa: F403
from rlcli_oige.maths import TENSOR_NAMES
from rlcli_oige.rotations import *  # noqa: F403
from rlcli_oige.rotations import ROTATION_NAMES
from rlcli_oige.stage import (
    Ant,
    Cartpole,
    Crazyflie,
    DynamicCuboid,
    DynamicCylinder,
    DynamicSphere,
    FixedCuboid,
    FixedCylinder,
    FixedSphere,
    GroundPlane,
    Humanoid,
    Ingenuity,
    Quadcopter,
    RigidPrim,
    Robot,
    VisualCuboid,
    VisualSphere,
    XFormPrim,
    add_reference_to_stage,
    define_prim,
    find_matching_prim_paths,
    get_assets_root_path,
    get_current_stage,
    get_prim_at_path,
    is_prim_path_valid,
)
from rlcli_oige.task import RLTask, SimConfig, World
from rlcli_oige.usd import ArticulationAction, Gf, PhysxSchema, Sdf, Usd, UsdGeom, UsdLux, UsdPhysics, carb, omni
from rlcli_oige.views import RigidPrimView, XFormPrimView

NAMES = [
    *TENSOR_NAMES,
    *ROTATION_NAMES,
    "Ant", "ArticulationAction", "ArticulationView", "Cartpole", "Crazyflie", "DynamicCuboid", "DynamicCylinder",
    "DynamicSphere", "FixedCuboid", "FixedCylinder", "FixedSphere", "Gf", "GroundPlane", "Humanoid", "Ingenuity",
    "PhysxSchema", "Quadcopter", "RLTask", "RigidPrim", "RigidPrimView", "Robot", "Sdf", "SimConfig", "Usd", "UsdGeom",
    "UsdLux", "UsdPhysics", "VisualCuboid", "VisualSphere", "World", "XFormPrim", "XFormPrimView",
    "add_reference_to_stage", "carb", "define_prim", "find_matching_prim_paths", "get_assets_root_path",
    "get_current_stage", "get_prim_at_path", "is_prim_path_valid", "omni", "torch_utils",
]  # fmt: skip
"""Names that `rlcli_oige` exports; `torch_utils` is the package itself."""

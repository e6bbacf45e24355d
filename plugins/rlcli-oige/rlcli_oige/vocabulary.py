# ruff: noqa: F401
"""Names that `rlcli_oige` exports, collected in one module, which is imported when a name is first used."""

from rlcli_oige.articulation_view import ArticulationView
from rlcli_oige.cameras import Camera, add_update_semantics
from rlcli_oige.maths import *  # noqa: F403
from rlcli_oige.maths import TENSOR_NAMES
from rlcli_oige.randomization import Randomizer
from rlcli_oige.rotations import *  # noqa: F403
from rlcli_oige.rotations import ROTATION_NAMES
from rlcli_oige.scene_objects import (
    Ant,
    Cartpole,
    Cloner,
    Crazyflie,
    DynamicCuboid,
    DynamicCylinder,
    DynamicSphere,
    FixedCuboid,
    FixedCylinder,
    FixedSphere,
    GridCloner,
    GroundPlane,
    Humanoid,
    Ingenuity,
    Quadcopter,
    RigidPrim,
    Robot,
    VisualCuboid,
    VisualSphere,
    WheeledRobot,
    XFormPrim,
)
from rlcli_oige.stage import (
    add_reference_to_stage,
    define_prim,
    find_matching_prim_paths,
    get_assets_root_path,
    get_current_stage,
    get_prim_at_path,
    is_prim_path_valid,
)
from rlcli_oige.task import RLTask, SimConfig, SimulationContext, World
from rlcli_oige.usd_names import (
    ArticulationAction,
    Gf,
    PhysxSchema,
    Sdf,
    Usd,
    UsdGeom,
    UsdLux,
    UsdPhysics,
    UsdShade,
    carb,
)
from rlcli_oige.views import RigidPrimView, XFormPrimView

MATHS = [*TENSOR_NAMES, *ROTATION_NAMES]
"""Names of tensor functions, which `from MODULE import *` defines for every module of Omniverse."""

NAMES = [
    *MATHS,
    "Ant", "ArticulationAction", "ArticulationView", "Camera", "Cartpole", "Cloner", "Crazyflie", "DynamicCuboid",
    "DynamicCylinder", "DynamicSphere", "FixedCuboid", "FixedCylinder", "FixedSphere", "Gf", "GridCloner",
    "GroundPlane",
    "Humanoid", "Ingenuity", "PhysxSchema", "Quadcopter", "RLTask", "Randomizer", "RigidPrim", "RigidPrimView", "Robot",
    "Sdf", "SimConfig", "SimulationContext", "Usd", "UsdGeom", "UsdLux", "UsdPhysics", "UsdShade", "VisualCuboid",
    "VisualSphere", "WheeledRobot", "World", "XFormPrim", "XFormPrimView", "add_reference_to_stage",
    "add_update_semantics", "carb",
    "define_prim", "find_matching_prim_paths", "get_assets_root_path", "get_current_stage", "get_prim_at_path",
    "is_prim_path_valid", "torch_utils",
]  # fmt: skip
"""Names that `rlcli_oige` exports; `torch_utils` is the package itself."""

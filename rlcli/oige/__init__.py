# ruff: noqa: F401
"""OmniIsaacGymEnvs' vocabulary, flat: change a task's import lines to `from rlcli.oige import ...`, and it runs here.

A name that is not one of these is looked for in the Python files beside the file that imports it, and below the folder
of the task's YAML: a task's shared modules and view classes are imported from here too.
"""

from __future__ import annotations

from typing import Any

from rlcli.oige.maths import *  # noqa: F403
from rlcli.oige.maths import TENSOR_NAMES
from rlcli.oige.rotations import *  # noqa: F403
from rlcli.oige.rotations import ROTATION_NAMES
from rlcli.oige.stage import (
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
from rlcli.oige.task import RLTask, SimConfig, World
from rlcli.oige.usd import ArticulationAction, Gf, PhysxSchema, Sdf, Usd, UsdGeom, UsdLux, UsdPhysics, carb, omni
from rlcli.oige.views import ArticulationView, RigidPrimView, XFormPrimView

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
"""What is offered here itself."""


def __getattr__(name: str) -> Any:
    if name == "torch_utils":
        import sys

        return sys.modules[__name__]
    if name == "__all__":  # `import *` gives a task's file what it uses of its neighbours, too
        from rlcli.oige.neighbours import used

        return [*NAMES, *used(NAMES)]
    if name.startswith("__"):
        raise AttributeError(name)
    from rlcli.oige.neighbours import find

    return find(name, NAMES)

"""Configuration classes of the simulation and of models, shapes, lights and materials.

A task of Isaac Lab that imports a name from `isaaclab.sim` gets the object of this name from here.

Settings of Isaac Sim without a counterpart are accepted and reported as ignored; docs/guides/isaac-lab.md lists the
settings that have an effect.
"""

from __future__ import annotations

import copy
from typing import Any

from rlcli_isaaclab.config_class import configclass
from rlcli_isaaclab.setup_scene import Spawn


class _OpenSettings:
    """Configuration class that accepts settings of any name. `scene_reader.py` reports those that have no effect."""

    __settings__ = True
    _fixed: dict[str, Any]

    def __init__(self, *values: Any, **settings: Any) -> None:
        positional = dict(zip(getattr(self, "_order", ()), values, strict=False))
        vars(self).update({**copy.deepcopy(self._fixed), **positional, **settings})
        if hasattr(self, "__post_init__"):
            self.__post_init__()

    def replace(self, **changes: Any) -> Any:
        """Return a copy in which the given settings have other values."""
        copied = copy.deepcopy(self)
        vars(copied).update(changes)
        return copied

    copy = replace


def _settings_class(name: str, doc: str, **fixed: Any) -> Any:
    return type(name, (_OpenSettings,), {"__doc__": doc, "_fixed": fixed, "__module__": __name__})


RigidBodyPropertiesCfg = _settings_class("RigidBodyPropertiesCfg", "PhysX settings of rigid bodies.")
ArticulationRootPropertiesCfg = _settings_class("ArticulationRootPropertiesCfg", "PhysX settings of an articulation.")
CollisionPropertiesCfg = _settings_class("CollisionPropertiesCfg", "PhysX settings of collisions.")
MassPropertiesCfg = _settings_class("MassPropertiesCfg", "Mass [kg] or density [kg/m^3].")
JointDrivePropertiesCfg = _settings_class("JointDrivePropertiesCfg", "PhysX settings of drives.")
FixedTendonPropertiesCfg = _settings_class("FixedTendonPropertiesCfg", "PhysX settings of tendons.")
DeformableBodyPropertiesCfg = _settings_class("DeformableBodyPropertiesCfg", "PhysX settings of soft bodies.")
RigidBodyMaterialCfg = _settings_class(
    "RigidBodyMaterialCfg", "Friction and restitution of contacts.", func=Spawn("spawn_rigid_body_material"),
    static_friction=0.5, dynamic_friction=0.5, restitution=0.0,
)  # fmt: skip
PreviewSurfaceCfg = _settings_class("PreviewSurfaceCfg", "Colour of a shape.", func=Spawn("spawn_preview_surface"))
MdlFileCfg = _settings_class(
    "MdlFileCfg", "Material of Isaac Sim, from an MDL file.", func=Spawn("spawn_from_mdl_file")
)
PhysxCfg = _settings_class("PhysxCfg", "Settings of the solver PhysX.")
RenderCfg = _settings_class("RenderCfg", "Settings of the renderer.")

GroundPlaneCfg = _settings_class(
    "GroundPlaneCfg", "A ground plane.", func=Spawn("spawn_ground_plane"), size=(100.0, 100.0)
)
DomeLightCfg = _settings_class(
    "DomeLightCfg", "Light from all directions.", func=Spawn("spawn_light"), prim_type="DomeLight"
)
DistantLightCfg = _settings_class(
    "DistantLightCfg", "Parallel light.", func=Spawn("spawn_light"), prim_type="DistantLight"
)
SphereLightCfg = _settings_class(
    "SphereLightCfg", "A spherical light.", func=Spawn("spawn_light"), prim_type="SphereLight"
)
DiskLightCfg = _settings_class("DiskLightCfg", "A light from a disk.", func=Spawn("spawn_light"), prim_type="DiskLight")
CylinderLightCfg = _settings_class(
    "CylinderLightCfg", "A cylindrical light.", func=Spawn("spawn_light"), prim_type="CylinderLight"
)
UsdFileCfg = _settings_class(
    "UsdFileCfg",
    "Model, given by the path of a USD file; `model_lookup.py` finds the MJCF for it.",
    func=Spawn("spawn_from_usd"),
)
UrdfFileCfg = _settings_class(
    "UrdfFileCfg",
    "Model, given by the path of a URDF file; `model_lookup.py` finds the MJCF for it.",
    func=Spawn("spawn_from_urdf"),
)
CuboidCfg = _settings_class("CuboidCfg", "A box; `size` are its edges [m].", func=Spawn("spawn_cuboid"))
SphereCfg = _settings_class("SphereCfg", "A sphere.", func=Spawn("spawn_sphere"))
CapsuleCfg = _settings_class("CapsuleCfg", "A capsule.", func=Spawn("spawn_capsule"))
CylinderCfg = _settings_class("CylinderCfg", "A cylinder.", func=Spawn("spawn_cylinder"))
ConeCfg = _settings_class("ConeCfg", "A cone.", func=Spawn("spawn_cone"))
MeshCuboidCfg = _settings_class("MeshCuboidCfg", "A mesh of a box.", func=Spawn("spawn_mesh_cuboid"))
MeshSphereCfg = _settings_class("MeshSphereCfg", "A mesh of a sphere.", func=Spawn("spawn_mesh_sphere"))
MeshCapsuleCfg = _settings_class("MeshCapsuleCfg", "A mesh of a capsule.", func=Spawn("spawn_mesh_capsule"))
MeshCylinderCfg = _settings_class("MeshCylinderCfg", "A mesh of a cylinder.", func=Spawn("spawn_mesh_cylinder"))
MeshConeCfg = _settings_class("MeshConeCfg", "A mesh of a cone.", func=Spawn("spawn_mesh_cone"))


@configclass
class SimulationCfg:
    """Settings of the simulation."""

    physics_prim_path: str = "/physicsScene"
    device: str = "cuda:0"
    dt: float = 1.0 / 60.0
    render_interval: int = 1
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
    enable_scene_query_support: bool = False
    use_fabric: bool = True
    physx: Any = PhysxCfg()
    physics_material: Any = RigidBodyMaterialCfg()
    render: Any = RenderCfg()
    create_stage_in_memory: bool = False
    logging_level: str = "WARNING"
    save_logs_to_file: bool = True
    log_dir: Any = None


__all__ = [name for name in dict(globals()) if name.endswith("Cfg")]

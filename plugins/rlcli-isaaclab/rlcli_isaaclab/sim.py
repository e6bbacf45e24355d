"""What stands in a scene and how it is simulated. Names as in `isaaclab.sim`, usually imported as `sim_utils`.

Settings that only Isaac Sim knows are accepted and reported; those in use are in docs/guides/isaac-lab.md.
"""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.config_class import configclass


class _Open:
    """Settings of which any may be given; which of them mean something here is said when they are read."""

    __settings__ = True
    _fixed: dict[str, Any]

    def __init__(self, *values: Any, **given: Any) -> None:
        positional = dict(zip(getattr(self, "_order", ()), values, strict=False))
        vars(self).update({**self._fixed, **positional, **given})

    def replace(self, **changes: Any) -> Any:
        """A copy with some members changed."""
        made = type(self)()
        vars(made).update({**vars(self), **changes})
        return made


def _open(name: str, doc: str, **fixed: Any) -> Any:
    return type(name, (_Open,), {"__doc__": doc, "_fixed": fixed, "__module__": __name__})


RigidBodyPropertiesCfg = _open("RigidBodyPropertiesCfg", "PhysX settings of rigid bodies.")
ArticulationRootPropertiesCfg = _open("ArticulationRootPropertiesCfg", "PhysX settings of an articulation.")
CollisionPropertiesCfg = _open("CollisionPropertiesCfg", "PhysX settings of collisions.")
MassPropertiesCfg = _open("MassPropertiesCfg", "Mass [kg] or density [kg/m^3].")
JointDrivePropertiesCfg = _open("JointDrivePropertiesCfg", "PhysX settings of drives.")
FixedTendonPropertiesCfg = _open("FixedTendonPropertiesCfg", "PhysX settings of tendons.")
DeformableBodyPropertiesCfg = _open("DeformableBodyPropertiesCfg", "PhysX settings of soft bodies.")
RigidBodyMaterialCfg = _open(
    "RigidBodyMaterialCfg", "Friction and restitution.", func="spawn_rigid_body_material", static_friction=0.5,
    dynamic_friction=0.5, restitution=0.0,
)  # fmt: skip
PreviewSurfaceCfg = _open("PreviewSurfaceCfg", "A colour.", func="spawn_preview_surface")
MdlFileCfg = _open("MdlFileCfg", "A material of Isaac Sim.", func="spawn_from_mdl_file")
PhysxCfg = _open("PhysxCfg", "The PhysX solver.")
RenderCfg = _open("RenderCfg", "The renderer.")

GroundPlaneCfg = _open("GroundPlaneCfg", "A ground plane.", func="spawn_ground_plane", size=(100.0, 100.0))
DomeLightCfg = _open("DomeLightCfg", "Light from everywhere.", func="spawn_light", prim_type="DomeLight")
DistantLightCfg = _open("DistantLightCfg", "Parallel light.", func="spawn_light", prim_type="DistantLight")
SphereLightCfg = _open("SphereLightCfg", "A lamp.", func="spawn_light", prim_type="SphereLight")
DiskLightCfg = _open("DiskLightCfg", "A lamp.", func="spawn_light", prim_type="DiskLight")
CylinderLightCfg = _open("CylinderLightCfg", "A lamp.", func="spawn_light", prim_type="CylinderLight")
UsdFileCfg = _open("UsdFileCfg", "A model by its USD path; assets.py maps it to an MJCF.", func="spawn_from_usd")
UrdfFileCfg = _open("UrdfFileCfg", "A model by its URDF path; assets.py maps it.", func="spawn_from_urdf")
CuboidCfg = _open("CuboidCfg", "A box; `size` are its edges [m].", func="spawn_cuboid")
SphereCfg = _open("SphereCfg", "A sphere.", func="spawn_sphere")
CapsuleCfg = _open("CapsuleCfg", "A capsule.", func="spawn_capsule")
CylinderCfg = _open("CylinderCfg", "A cylinder.", func="spawn_cylinder")
ConeCfg = _open("ConeCfg", "A cone.", func="spawn_cone")


@configclass
class SimulationCfg:
    """The simulation."""

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


__all__ = [name for name in dict(globals()) if name.endswith("Cfg")]

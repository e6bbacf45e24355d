"""Reader of shapes: boxes, spheres, cylinders, capsules and cones that a task spawns without a model."""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.body_properties import read_body_properties
from rlcli_isaaclab.missing_names import reason_of
from rlcli_isaaclab.settings import Node, as_float, kind_of
from rlcli_isaaclab.terrain_reader import read_friction

SHAPES = {
    "spawn_cuboid": "box",
    "spawn_sphere": "sphere",
    "spawn_cylinder": "cylinder",
    "spawn_capsule": "capsule",
    "spawn_cone": "cone",
    "spawn_mesh_cuboid": "box",
    "spawn_mesh_sphere": "sphere",
    "spawn_mesh_cylinder": "cylinder",
    "spawn_mesh_capsule": "capsule",
    "spawn_mesh_cone": "cone",
}
"""Isaac Lab's spawn function -> rlcli's shape."""


def read_shape(item: Node, spawn: Node, shape: str) -> dict[str, Any]:
    """Return the settings of an entity with one geom.

    A rigid object moves freely, a kinematic one is a mocap body; any other shape is fixed in the world.
    """
    size = spawn.get("size") or [spawn.get(key) for key in ("radius", "height") if spawn.get(key) is not None]
    config: dict[str, Any] = {"shape": shape, "size": [as_float(v) for v in size]}
    rigid, mass = spawn.data.get("rigid_props") or {}, spawn.node("mass_props")
    if rigid.get("kinematic_enabled"):
        config["mocap"] = True
        spawn.node("rigid_props").mark_mapped("kinematic_enabled")
    elif kind_of(item.data.get("class_type")) == "RigidObject" or rigid:
        config |= {"free": True, "velocity_point": "com"}
    config |= read_body_properties(spawn)
    for key in ("mass", "density"):
        if mass.get(key):
            config[key] = as_float(mass.get(key))
    if "physics_material" in spawn:
        config |= read_friction(spawn.node("physics_material"))
    look = spawn.node("visual_material")
    if look.get("diffuse_color") is not None:
        config["color"] = [as_float(v) for v in look.get("diffuse_color")]
    init = item.node("init_state")
    config["pos"] = [as_float(v) for v in init.get("pos", (0.0, 0.0, 0.0))]
    config["quat"] = [as_float(v) for v in init.get("rot", (1.0, 0.0, 0.0, 0.0))]
    read_root_velocity(config, init)
    if shape in ("cylinder", "capsule", "cone"):
        config["axis"] = str(spawn.get("axis", "Z")).lower()
    has_mass = "mass" in config or "density" in config
    config["collides"] = _read_collision(spawn, bool(config.get("free")), has_mass)
    if "deformable_props" in spawn:
        spawn.report.problem((*spawn.key, "deformable_props"), *reason_of("deformable_props"))
    spawn.mark_mapped("func", "visible", "semantic_tags", "copy_from_source", "activate_contact_sensors")
    spawn.mark_mapped("visual_material_path", "physics_material_path", "visual_material")
    return config


def read_root_velocity(entity: dict[str, Any], init: Node) -> None:
    """Write the velocities of `init_state` that are not 0 into the settings of an entity."""
    for key in ("lin_vel", "ang_vel"):
        value = [as_float(v) for v in init.get(key, (0.0, 0.0, 0.0))]
        if any(value):
            entity.setdefault("init", {})[key] = value


def _read_collision(spawn: Node, is_free: bool, has_mass: bool) -> bool:
    """Return whether a shape collides: only with `collision_props`, and not with `collision_enabled=False`."""
    properties = spawn.node("collision_props")
    collides = "collision_props" in spawn and properties.get("collision_enabled", True)
    properties.mark_mapped(*properties.data)
    if is_free and not collides and not has_mass:
        spawn.report.entries[(*spawn.key, "mass_props")] = (
            "approximated",
            "a body that moves, without collisions and mass, has 1000 kg/m^3; PhysX gives it 1 kg",
        )
    return bool(collides)

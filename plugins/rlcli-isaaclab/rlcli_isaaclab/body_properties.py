"""Reader of `rigid_props` and `articulation_props` of a spawned asset, which are PhysX's settings of its bodies.

Settings of the conversion of a URDF file are read here, too: the MJCF takes the place of the converted file.
"""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.settings import Node, is_empty


def read_body_properties(spawn: Node, is_fixed: bool | None = None) -> dict[str, Any]:
    """Return rlcli's settings of an entity for these properties; report properties without a counterpart in rlcli.

    Args:
        spawn: settings `spawn` of the asset.
        is_fixed: whether the base of the asset's model is fixed; None: unknown.
    """
    rigid, articulation = spawn.node("rigid_props"), spawn.node("articulation_props")
    config = {"gravity": False} if rigid.get("disable_gravity") else {}
    rigid.mark_mapped(*(name for name in _OFF_BY_DEFAULT if not rigid.data.get(name)))
    for node, name, without_effect in (
        (rigid, "rigid_body_enabled", True),
        (rigid, "enable_gyroscopic_forces", True),
        (articulation, "articulation_enabled", True),
        (articulation, "fix_root_link", is_fixed),
        (spawn, "fix_base", is_fixed),
    ):
        if node.data.get(name) is not None and node.data[name] == without_effect:
            node.mark_mapped(name)
    for node in (rigid, articulation):
        for name, value in node.data.items():
            if value is not None and (*node.key, name) not in node.report.entries:
                node.report.entries[(*node.key, name)] = ("ignored", _REASONS.get(name, "MuJoCo has no such setting"))
    for name in sorted(_URDF & spawn.data.keys()):
        if not is_empty(spawn.data[name]) and (*spawn.key, name) not in spawn.report.entries:
            spawn.report.entries[(*spawn.key, name)] = ("ignored", _REASONS[name])
    return config


_OFF_BY_DEFAULT = ("linear_damping", "angular_damping", "retain_accelerations")
_SOLVER = "MuJoCo's solver has its own settings: sim.iterations, the <option> of the MJCF"
_DAMPING = "set the damping of joints, or the density and viscosity of <option>, in the MJCF"
_BASE = "the MJCF decides: a root body with a free joint moves, without one it is fixed"
_COLLIDE = "contype, conaffinity and <exclude> of the MJCF decide which bodies collide"
_GEOMS = "the geoms of the MJCF collide"
_URDF = {"fix_base", "joint_drive", "replace_cylinders_with_capsules", "collision_from_visuals", "collider_type"}
_URDF |= {"self_collision", "merge_fixed_joints", "link_density"}
_REASONS = {
    "linear_damping": _DAMPING,
    "angular_damping": _DAMPING,
    "max_depenetration_velocity": "set solref and solimp of the geoms in the MJCF",
    "solver_position_iteration_count": _SOLVER,
    "solver_velocity_iteration_count": _SOLVER,
    "enabled_self_collisions": _COLLIDE,
    "fix_root_link": _BASE,
    "fix_base": _BASE,
    "joint_drive": "the gains of the actuators, or else those of the MJCF, apply",
    "replace_cylinders_with_capsules": _GEOMS,
    "collision_from_visuals": _GEOMS,
    "collider_type": _GEOMS,
    "self_collision": _COLLIDE,
    "merge_fixed_joints": "the bodies of the MJCF are simulated",
    "link_density": "the MJCF sets the masses of bodies",
    "kinematic_enabled": 'write mocap="true" at the root body of the MJCF, so that events can move it',
    "rigid_body_enabled": "all bodies of the MJCF are simulated",
    "articulation_enabled": "all joints of the MJCF are simulated",
    "enable_gyroscopic_forces": "MuJoCo always computes them",
}
"""Property that is ignored -> the reason, or what to set instead."""

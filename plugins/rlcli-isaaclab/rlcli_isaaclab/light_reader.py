"""Reader of Isaac Lab's settings of lights."""

from __future__ import annotations

from typing import Any

from rlcli_isaaclab.settings import Node, Report, as_float


def read_light(report: Report, item: Node, spawn: Node, lights: dict[str, Any]) -> None:
    """Add a dome or distant light of Isaac Lab to `lights`, the lights of the task by kind; report other lights.

    Args:
        report: receives how each setting was translated.
        item: settings of the light in the scene.
        spawn: settings of its `spawn`.
        lights: kind of light -> settings in the task; the light is added here.
    """
    item.mark_mapped("prim_path", "collision_group", "debug_vis", "class_type")
    spawn.mark_mapped("func", "prim_type", "visible", "semantic_tags", "copy_from_source", "normalize", "exposure")
    spawn.mark_mapped(
        "enable_color_temperature", "color_temperature", "texture_format", "visible_in_primary_ray", "angle"
    )
    kind = {"DomeLight": "dome", "DistantLight": "distant"}.get(str(spawn.data.get("prim_type")))
    if kind is None:
        report.entries[item.key] = ("ignored", "only dome and distant lights have a counterpart")
        return
    config = {
        "color": [as_float(v) for v in spawn.get("color", (1.0, 1.0, 1.0))],
        "intensity": as_float(spawn.get("intensity", 1000.0)),
    }
    rotation = [as_float(v) for v in item.node("init_state").get("rot", (1.0, 0.0, 0.0, 0.0))]
    if kind == "distant":
        config["direction"] = _direction_of(rotation)
    item.node("init_state").mark_mapped("pos", "rot")
    if kind in lights:
        report.entries[item.key] = ("ignored", f"rlcli supports one {kind} light in a scene, and uses the first")
        return
    lights[kind] = config


def _direction_of(quat: list[float]) -> list[float]:
    """Return the direction of a distant light: (0, 0, -1) rotated by a quaternion (w, x, y, z)."""
    w, x, y, z = quat
    return [-2.0 * (x * z + w * y), -2.0 * (y * z - w * x), -(1.0 - 2.0 * (x * x + y * y))]

"""Reader of Isaac Lab's contact and ray sensors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rlcli.errors import listing
from rlcli_isaaclab.settings import Node, as_float, kind_of, to_plain


def read_sensor(kind: str, item: Node, prims: Mapping[str, str]) -> dict[str, Any] | None:
    """Return the settings of one sensor; None if it has no counterpart.

    Args:
        kind: Isaac Lab's class of the sensor.
        item: settings of the sensor.
        prims: entity -> the last part of its prim path.
    """
    item.skip("class_type", "debug_vis", "visualizer_cfg", "track_pose", "max_contact_data_count_per_prim")
    prim = str(item.get("prim_path") or "")
    parts = [part for part in prim.split("/") if part]
    entity = next((name for name, last in prims.items() if last in parts), None)
    if entity is None:
        hint = f"prims: {listing(prims)}"
        item.report.problem((*item.key, "prim_path"), f"'{prim}' is not inside an entity", hint)
        return None
    inside = parts[parts.index(prims[entity]) + 1 :]
    body = inside[-1] if inside else None
    if item.data.get("update_period"):
        item.note("ignored", "update_period", "sensors are updated in every step")
    else:
        item.skip("update_period")
    if kind == "ContactSensor":
        return _read_contact_sensor(item, entity, body)
    if kind == "RayCaster":
        return _read_ray_sensor(item, entity, body)
    item.report.entries[item.key] = ("ignored", "read the MJCF's own sensors with the term `sensor_data`")
    return None


def _read_contact_sensor(item: Node, entity: str, body: str | None) -> dict[str, Any]:
    item.skip("track_contact_points", "track_friction_forces")
    item.note("approximated", "track_air_time", "times are multiples of the environment step, not of the physics step")
    config: dict[str, Any] = {"kind": "contact", "entity": entity, "bodies": body or ".*"}
    history = item.get("history_length", 0)
    if history > 1:
        config["history"] = history
        item.note("approximated", "history_length", "counts environment steps, not physics steps")
    config["force_threshold"] = as_float(item.get("force_threshold", 1.0))
    if item.data.get("filter_prim_paths_expr"):
        item.note("ignored", "filter_prim_paths_expr", "write `against` of the contact sensor")
    else:
        item.skip("filter_prim_paths_expr")
    return config


def _read_ray_sensor(item: Node, entity: str, body: str | None) -> dict[str, Any]:
    item.skip("mesh_prim_paths", "history_length", "attach_yaw_only", "drift_range", "ray_cast_drift_range")
    pattern, offset = item.node("pattern_cfg"), item.node("offset")
    config: dict[str, Any] = {"kind": "rays", "entity": entity}
    if body is not None:
        config["body"] = body
    if kind_of(pattern.get("func")) != "grid_pattern":
        item.report.problem(pattern.key, "only patterns.GridPatternCfg has a counterpart in rlcli; use it")
    pattern.skip("ordering")
    grid = {
        "size": list(pattern.get("size", (1.0, 1.0))),
        "resolution": pattern.get("resolution", 0.1),
        "direction": list(pattern.get("direction", (0.0, 0.0, -1.0))),
    }
    config["pattern"] = to_plain(grid)
    config["offset"] = [as_float(v) for v in offset.get("pos", (0.0, 0.0, 0.0))]
    if list(offset.data.get("rot", (1, 0, 0, 0))) != [1, 0, 0, 0]:
        offset.note("ignored", "rot", "set the pattern's direction instead")
    else:
        offset.skip("rot")
    # Older versions of Isaac Lab have attach_yaw_only, newer ones ray_alignment.
    yaw_only = item.data.get("attach_yaw_only")
    config["alignment"] = "yaw" if yaw_only else item.get("ray_alignment", "base")
    item.skip("ray_alignment")
    config["max_distance"] = as_float(item.get("max_distance", 1e6))
    return config

"""Reader of the settings of Isaac Lab's sensors: contact and ray sensors, cameras, IMUs, frame transformers."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

from rlcli.errors import listing
from rlcli_isaaclab.settings import Node, as_float, kind_of, to_plain


def read_sensor(kind: str, item: Node, prims: Mapping[str, str], frames: dict[str, Any]) -> dict[str, Any] | None:
    """Return the settings of one sensor for `scene.sensors`; None if it has no counterpart there.

    Args:
        kind: Isaac Lab's class of the sensor.
        item: settings of the sensor.
        prims: entity -> the last part of its prim path.
        frames: receives the settings of frame transformers, which only the user's terms read.
    """
    item.mark_mapped("class_type", "debug_vis", "visualizer_cfg", "track_pose", "max_contact_data_count_per_prim")
    prim = str(item.get("prim_path") or "")
    parts = [part for part in prim.split("/") if part]
    entity = next((name for name, last in prims.items() if last in parts), None)
    if kind in ("Camera", "TiledCamera"):
        return read_camera(item, entity, parts[parts.index(prims[entity]) + 1 : -1] if entity else [])
    if kind in ("RayCasterCamera", "MultiMeshRayCasterCamera"):
        return read_camera(_as_camera(item), entity, parts[parts.index(prims[entity]) + 1 :] if entity else [])
    if entity is None:
        hint = f"prims of robots and objects: {listing(prims.values())}"
        item.report.problem((*item.key, "prim_path"), f"'{prim}' is not a prim of a robot or object", hint)
        return None
    inside = parts[parts.index(prims[entity]) + 1 :]
    body = inside[-1] if inside else None
    if item.data.get("update_period"):
        item.note("ignored", "update_period", "rlcli updates sensors in every environment step")
    else:
        item.mark_mapped("update_period")
    if kind == "ContactSensor":
        return _read_contact_sensor(item, entity, body)
    if kind == "RayCaster":
        return _read_ray_sensor(item, entity, body)
    if kind == "FrameTransformer":
        frames[item.key[-1]] = _read_frames(item, entity, body, prims)
        return None
    item.report.entries[item.key] = ("ignored", "read the MJCF's own sensors with the term `sensor_data`")
    return None


def _as_camera(item: Node) -> Node:
    """Return the settings of a camera of rays in the form of those of a camera."""
    why = "a rendered image, which shows the whole scene, and not only the meshes of the sensor"
    item.note("approximated", "mesh_prim_paths", why)
    item.mark_mapped("pattern_cfg", "max_distance", "ray_alignment", "attach_yaw_only")
    pattern, far = dict(item.data["pattern_cfg"]), item.data.get("max_distance", 1e6)
    size = {key: pattern.pop(key) for key in ("width", "height")}
    spawn = {**pattern, "clipping_range": (0.01, far)}
    return Node({**item.data, **size, "spawn": spawn}, item.key, item.report)


def _read_frames(item: Node, entity: str, body: str | None, prims: Mapping[str, str]) -> dict[str, Any]:
    """Return the settings of a frame transformer: `source`, a frame, and `targets`, a list of frames (see `_frame`)."""
    targets = []
    for target in item.get("target_frames") or ():
        frame = Node(target, (*item.key, "target_frames"), item.report)
        parts = [part for part in str(frame.get("prim_path")).split("/") if part]
        owner = next((name for name, last in prims.items() if last in parts), entity)
        inside = parts[parts.index(prims[owner]) + 1 :] if prims[owner] in parts else []
        targets.append(
            {"name": frame.get("name"), **_frame(owner, inside[-1] if inside else None, frame.node("offset"))}
        )
    return {"source": _frame(entity, body, item.node("source_frame_offset")), "targets": targets}


def _frame(entity: str, body: str | None, offset: Node) -> dict[str, Any]:
    pos, rot = offset.get("pos", (0.0, 0.0, 0.0)), offset.get("rot", (1.0, 0.0, 0.0, 0.0))
    return {"entity": entity, "body": body, "pos": [as_float(v) for v in pos], "rot": [as_float(v) for v in rot]}


CAMERA_DATA = {
    "rgb": "rgb",
    "rgba": "rgb",
    "depth": "depth",
    "distance_to_image_plane": "depth",
    "distance_to_camera": "distance",
}
"""Isaac Lab's type of image -> the setting `data` of a camera in rlcli."""
_FORWARD = {
    "world": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "ros": ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    "opengl": ((0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
}
"""Isaac Lab's `convention` -> viewing direction and upward direction of the camera, before `rot` rotates them."""


def read_camera(item: Node, entity: str | None, inside: list[str]) -> dict[str, Any] | None:
    """Return the settings of a camera, or None after reporting why it cannot be read.

    Args:
        item: Isaac Lab's settings of the camera.
        entity: entity to whose body the camera is fixed; None: it is fixed in the environment.
        inside: parts of the camera's prim path between the entity and the camera, such as names of bodies.
    """
    wanted = list(item.get("data_types", ["rgb"]))
    kinds = camera_kinds(wanted)
    absent = [name for name in wanted if name not in CAMERA_DATA]
    if not kinds:
        what = f"a camera has {listing(CAMERA_DATA)}; found {listing(wanted)}"
        item.report.problem((*item.key, "data_types"), what, "segmentation and normals have no counterpart")
        return None
    if absent:
        why = f"without {listing(absent)}, which have no counterpart: code that reads them raises an error"
        item.report.entries[(*item.key, "data_types")] = ("approximated", why)
    offset, spawn = item.node("offset"), item.node("spawn")
    convention = offset.get("convention", "ros")
    eye = [as_float(v) for v in offset.get("pos", (0.0, 0.0, 0.0))]
    rot = [as_float(v) for v in offset.get("rot", (1.0, 0.0, 0.0, 0.0))]
    forward, up = (_rotated(rot, axis) for axis in _FORWARD.get(convention, _FORWARD["ros"]))
    if up[2] < 0.5 * max(0.0, 1.0 - forward[2] ** 2) ** 0.5 - 1e-3:
        offset.note("approximated", "rot", "the camera's roll is dropped: the image's upper edge is horizontal")
    width, height = item.require("width"), item.require("height")
    aperture = spawn.get("vertical_aperture") or spawn.get("horizontal_aperture", 20.955) * height / width
    near, far = spawn.get("clipping_range", (0.01, 1e6))
    config: dict[str, Any] = {
        "kind": "camera",
        "data": kinds[0],
        "width": width,
        "height": height,
        "eye": eye,
        "lookat": [a + b for a, b in zip(eye, forward, strict=True)],
        "fov": math.degrees(2.0 * math.atan(aperture / (2.0 * spawn.get("focal_length", 24.0)))),
        "clip": [as_float(near), min(as_float(far), 1e4)],
    }
    if entity is not None:
        config["entity"] = entity
        if inside:
            config["body"] = inside[-1]
    spawn.mark_mapped(
        "func",
        "focus_distance",
        "f_stop",
        "projection_type",
        "visible",
        "semantic_tags",
        "copy_from_source",
        "lock_camera",
    )
    item.mark_mapped(
        "update_latest_camera_pose",
        "semantic_filter",
        "depth_clipping_behavior",
        "prim_path",
        "colorize_semantic_segmentation",
    )
    item.mark_mapped(
        "colorize_instance_id_segmentation",
        "colorize_instance_segmentation",
        "semantic_segmentation_mapping",
        "history_length",
    )
    return config


def camera_kinds(wanted: Iterable[str]) -> list[str]:
    """Return the values of rlcli's setting `data` for Isaac Lab's `data_types`, without types that rlcli lacks."""
    return list(dict.fromkeys(CAMERA_DATA[name] for name in wanted if name in CAMERA_DATA))


def image_name(camera: str, kind: str) -> str:
    """Return the name of the sensor for a second kind of image of a camera, such as `front__depth`."""
    return f"{camera}__{kind}"


def choose_image(params: Node, config: dict[str, Any], sensors: dict[str, Any]) -> None:
    """Set `sensor` of the observation term `image` to the sensor of the camera that has the images `data_type`.

    Args:
        params: Isaac Lab's parameters of the term. A `data_type` that the camera lacks is reported as a mistake.
        config: settings of rlcli's term, changed in place.
        sensors: settings of all sensors by name. A sensor of depths is added if the term converts distances to depths.
    """
    camera, wanted = config.get("sensor", "tiled_camera"), str(params.data.get("data_type", "rgb"))
    base = sensors.get(camera)
    if base is None or base["kind"] != "camera":
        return  # the check of the term reports it
    made = {data: name for data in CAMERA_DATA.values() if (name := image_name(camera, data)) in sensors}
    made[base["data"]] = camera
    data = CAMERA_DATA.get(wanted)
    if data not in made:
        hint = f"images of rlcli's cameras: {listing(CAMERA_DATA)}; data_types of the camera must have the type"
        params.report.problem((*params.key, "data_type"), f"'{camera}' has no images of the type '{wanted}'", hint)
        return
    if data == "distance" and params.data.get("convert_perspective_to_orthogonal"):
        data = "depth"  # the distance along the optical axis
        sensors.setdefault(made.setdefault(data, image_name(camera, data)), {**base, "data": data})
    config["sensor"] = made[data]


def _rotated(quat: Sequence[float], axis: Sequence[float]) -> list[float]:
    w, x, y, z = quat
    a, b, c = axis
    return [
        (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c,
        2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c,
        2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c,
    ]


def _read_contact_sensor(item: Node, entity: str, body: str | None) -> dict[str, Any]:
    item.mark_mapped("track_contact_points", "track_friction_forces")
    item.note("approximated", "track_air_time", "times are multiples of the environment step, not of the physics step")
    config: dict[str, Any] = {"kind": "contact", "entity": entity, "bodies": body or ".*"}
    history = item.get("history_length", 0)
    if history > 1:
        config["history"] = history
        item.note("approximated", "history_length", "counts environment steps, not physics steps")
    config["force_threshold"] = as_float(item.get("force_threshold", 1.0))
    return config


def read_filters(item: Node, sensor: Mapping[str, Any], prims: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return the settings of one more contact sensor for each entry of `filter_prim_paths_expr`.

    Such a sensor measures the contacts with one body; `Sensor.force_matrix_w` stacks their forces.
    """
    found = []
    for path in item.get("filter_prim_paths_expr") or ():
        parts = [part for part in str(path).split("/") if part]
        entity = next((name for name, last in prims.items() if last in parts), None)
        other: Any = "ground"
        if entity is not None:
            inside = parts[parts.index(prims[entity]) + 1 :]
            other = {"entity": entity, **({"bodies": inside[-1]} if inside else {})}
        elif not re.search("ground|terrain|plane", str(path), re.IGNORECASE):
            item.report.problem((*item.key, "filter_prim_paths_expr"), f"no entity has the prim '{path}'")
        found.append({"kind": "contact", "entity": sensor["entity"], "bodies": sensor["bodies"], "against": other})
    return found


def filter_name(sensor: str, index: int) -> str:
    """Return the name of the sensor for the entry `index` of a contact sensor's `filter_prim_paths_expr`."""
    return f"{sensor}_filter_{index}"


def _read_pattern(pattern: Node) -> Any:
    """Return the setting `pattern` of a ray sensor: a grid as a dict, or a list of directions of rays."""
    function = pattern.get("func")
    if kind_of(function) == "grid_pattern":
        pattern.mark_mapped("ordering")
        grid = {
            "size": list(pattern.get("size", (1.0, 1.0))),
            "resolution": pattern.get("resolution", 0.1),
            "direction": list(pattern.get("direction", (0.0, 0.0, -1.0))),
        }
        return to_plain(grid)
    if isinstance(function, str):  # a YAML file has only the name
        from rlcli_isaaclab.sensors import patterns

        function = getattr(patterns, kind_of(function), None)
    if not inspect.isfunction(function):
        hint = "use GridPatternCfg, LidarPatternCfg, BpearlPatternCfg or your own function"
        pattern.report.problem(pattern.key, "this pattern of rays has no counterpart in rlcli", hint)
        return [[0.0, 0.0, -1.0]]
    cfg = SimpleNamespace(**{key: pattern.get(key) for key in pattern.data})
    starts, directions = function(cfg, "cpu")
    if bool(starts.any()):
        what = "rays that start in different points, and not on a grid, have no counterpart in rlcli"
        pattern.report.problem(pattern.key, what, "use GridPatternCfg, or rays from one point")
    return [[round(value, 9) for value in ray] for ray in directions.tolist()]


def _read_ray_sensor(item: Node, entity: str, body: str | None) -> dict[str, Any]:
    item.mark_mapped("mesh_prim_paths", "history_length", "attach_yaw_only", "drift_range", "ray_cast_drift_range")
    pattern, offset = item.node("pattern_cfg"), item.node("offset")
    config: dict[str, Any] = {"kind": "rays", "entity": entity}
    if body is not None:
        config["body"] = body
    config["pattern"] = _read_pattern(pattern)
    config["offset"] = [as_float(v) for v in offset.get("pos", (0.0, 0.0, 0.0))]
    rot = [as_float(value) for value in offset.data.get("rot", (1, 0, 0, 0))]
    if isinstance(config["pattern"], list):
        config["pattern"] = [_rotated(rot, ray) for ray in config["pattern"]]
        offset.mark_mapped("rot")
    elif rot != [1, 0, 0, 0]:
        offset.note("ignored", "rot", "rays of a grid do not turn with the offset: set `direction` of the pattern")
    else:
        offset.mark_mapped("rot")
    # Older versions of Isaac Lab have attach_yaw_only, newer ones ray_alignment.
    yaw_only = item.data.get("attach_yaw_only")
    config["alignment"] = "yaw" if yaw_only else item.get("ray_alignment", "base")
    item.mark_mapped("ray_alignment")
    config["max_distance"] = as_float(item.get("max_distance", 1e6))
    return config

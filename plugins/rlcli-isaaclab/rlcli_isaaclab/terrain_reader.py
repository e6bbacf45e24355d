"""Reader of Isaac Lab's settings of the ground, the terrain and contact materials."""

from __future__ import annotations

from typing import Any

from rlcli.errors import listing
from rlcli_isaaclab.settings import Node, as_float, kind_of, to_plain

PLANE_SIZE = 100.0
"""Edge length of the ground plane that replaces a terrain without a generator [m]."""

_SUB_TERRAINS = {
    "flat_terrain": "flat",
    "random_uniform_terrain": "noise",
    "pyramid_sloped_terrain": "slope",
    "wave_terrain": "waves",
    "discrete_obstacles_terrain": "obstacles",
    "stepping_stones_terrain": "stones",
    "pyramid_stairs_terrain": "stairs",
    "inverted_pyramid_stairs_terrain": "stairs",
    "random_grid_terrain": "grid",
}
"""Isaac Lab's terrain function -> rlcli's kind of sub-terrain."""

_HEIGHT_RANGES = {
    "slope": ("slope_range", "slope"),
    "waves": ("amplitude_range", "amplitude"),
    "stairs": ("step_height_range", "step_height"),
    "obstacles": ("obstacle_height_range", "height"),
    "grid": ("grid_height_range", "height"),
    "noise": ("noise_range", "height"),
}
"""Kind of sub-terrain -> (Isaac Lab's key, rlcli's key) of the range from which the difficulty chooses a value."""

_OTHER_KEYS = {
    "noise": {"downsampled_scale": "spacing"},
    "waves": {"num_waves": "count"},
    "obstacles": {"obstacle_width_range": "width", "num_obstacles": "count"},
    "stones": {"stone_width_range": "width", "stone_distance_range": "gap"},
    "stairs": {"step_width": "step_width"},
    "grid": {"grid_width": "cell"},
}
"""Kind of sub-terrain -> Isaac Lab's key -> rlcli's key, for the settings that do not depend on the difficulty."""


def read_ground(item: Node, spawn: Node) -> dict[str, Any]:
    """Return the section `scene.ground` for a ground plane: size, height and friction."""
    item.mark_mapped("prim_path", "collision_group", "debug_vis", "class_type")
    init = item.node("init_state")
    x, y, height = (as_float(value) for value in init.get("pos", (0.0, 0.0, 0.0)))
    init.mark_mapped("rot", "class_type")
    if (x, y) != (0.0, 0.0):
        init.note("approximated", "pos", "the middle of the plane is at x = y = 0")
    spawn.mark_mapped("func", "visible", "color", "usd_path", "semantic_tags", "copy_from_source")
    size = as_float(max(spawn.get("size", (PLANE_SIZE, PLANE_SIZE))))
    level = {"height": height} if height else {}
    return {"size": size, **level, **read_friction(spawn.node("physics_material"))}


def read_friction(material: Node) -> dict[str, float]:
    """Return {"friction": sliding friction} of a contact material; {} for Isaac Lab's default of 0.5.

    Without the key, rlcli's own default applies.
    """
    material.mark_mapped("func", "restitution_combine_mode", "friction_combine_mode", "improve_patch_friction")
    material.mark_mapped("compliant_contact_stiffness", "compliant_contact_damping")
    static = material.get("static_friction", 0.5)
    dynamic = material.get("dynamic_friction", 0.5)
    if static != dynamic:
        material.note("approximated", "static_friction", "MuJoCo has one coefficient: dynamic_friction is used")
    if material.data.get("restitution"):
        material.note("ignored", "restitution", "in MuJoCo, solref of a geom sets how contacts bounce")
    else:
        material.mark_mapped("restitution")
    return {} if dynamic == 0.5 else {"friction": as_float(dynamic)}


def read_terrain(item: Node, scene: dict[str, Any]) -> dict[str, Any] | None:
    """Return the section `scene.ground` for a plane; for a generator write `terrain` into `scene`, and return None."""
    item.mark_mapped("class_type", "prim_path", "collision_group", "debug_vis", "num_envs", "env_spacing", "usd_path")
    item.mark_mapped("visual_material", "use_terrain_origins")
    kind = item.get("terrain_type", "generator")
    friction = read_friction(item.node("physics_material"))
    plane = {"size": PLANE_SIZE, **friction}
    if kind == "plane":
        item.mark_mapped("terrain_generator", "max_init_terrain_level")
        return plane
    generator = item.node("terrain_generator")
    if kind != "generator" or not generator.data:
        item.note("approximated", "terrain_type", "replaced by a plane: rlcli has planes and generated terrains")
        return plane
    scene["terrain"] = _read_generator(generator) | friction
    start_level = item.get("max_init_terrain_level")
    if start_level is not None:
        scene["terrain"]["max_start_level"] = start_level
    return None


def _read_generator(node: Node) -> dict[str, Any]:
    """Return the section `scene.terrain` for a terrain generator. rlcli builds every sub-terrain as a height field."""
    config: dict[str, Any] = {
        "kind": "generator",
        "rows": node.get("num_rows", 1),
        "columns": node.get("num_cols", 1),
        "patch": [as_float(v) for v in node.get("size", (8.0, 8.0))],
        "border": as_float(node.get("border_width", 0.0)),
        "resolution": as_float(node.get("horizontal_scale", 0.1)),
        "difficulty": [as_float(v) for v in node.get("difficulty_range", (0.0, 1.0))],
        "curriculum": bool(node.get("curriculum", False)),
        "sub_terrains": {},
    }
    if node.get("seed") is not None:
        config["seed"] = node.get("seed")
    node.mark_mapped("class_type", "color_scheme", "use_cache", "cache_dir", "vertical_scale", "border_height")
    node.note("approximated", "slope_threshold", "steps are slopes as wide as one cell, not vertical walls")
    for name, patch in node.node("sub_terrains").nodes():
        config["sub_terrains"][name] = _read_sub_terrain(patch, config["resolution"])
    return config


def _read_sub_terrain(node: Node, resolution: float) -> dict[str, Any]:
    """Return the settings of one sub-terrain; the name of Isaac Lab's terrain function decides its `kind`.

    `resolution` is the distance between two points of the height field [m].
    """
    function = kind_of(node.get("function"))
    proportion = as_float(node.get("proportion", 1.0))
    node.mark_mapped("size", "horizontal_scale", "vertical_scale", "slope_threshold", "flat_patch_sampling")
    kind = _SUB_TERRAINS.get(function)
    border = as_float(node.get("border_width", 0.0))
    if kind is None:
        why = f"replaced by flat ground: '{function}' has no counterpart; use one of {listing(_SUB_TERRAINS)}"
        node.report.entries[node.key] = ("approximated", why)
        return {"kind": "flat", "proportion": proportion}
    inverted = "inverted" in function or bool(node.data.get("inverted"))
    node.mark_mapped("inverted")
    config: dict[str, Any] = {"proportion": proportion, "kind": kind}
    if kind != "flat" and border:
        config["border"] = border
    if kind not in ("flat", "noise", "waves") and "platform_width" in node:
        config["platform"] = as_float(node.get("platform_width"))
    their_range, our_range = _HEIGHT_RANGES.get(kind, ("", ""))
    if their_range in node:
        config[our_range] = [as_float(v) for v in node.get(their_range)]
    for theirs, ours in _OTHER_KEYS.get(kind, {}).items():
        value = node.get(theirs)
        if value is not None:
            config[ours] = to_plain(value)
    if kind == "noise":
        config.setdefault("spacing", resolution)
        if "height" in config:  # rlcli has a range, Isaac Lab one height for every difficulty
            low, high = config["height"]
            config["height"] = [(high - low) / 2.0] * 2
            node.note("approximated", "noise_range", "heights are relative to the middle of the range")
        node.note("ignored", "noise_step", "heights are not rounded to multiples of a step")
    if kind in ("slope", "stairs") and inverted:
        config["inverted"] = True
    return config

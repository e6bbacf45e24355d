# ruff: noqa: E501
"""Stand-in models: MJCF files with the joints and bodies that the settings of a task of Isaac Lab mention."""

from __future__ import annotations

import inspect
import itertools
import re
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    import sre_parse

FLOATING = (
    *("anymal", "unitree", "a1", "go1", "go2", "h1", "g1", "spot", "cassie", "digit", "humanoid", "ant_", "crazyflie"),
    *("cf2x", "arl_robot", "gr1", "nova_carter"),
)
SIDES = ("left", "right")
EXTRA_BODIES = {
    "spot": ["fl_foot", "fr_foot", "hl_foot", "hr_foot", "body"],
    "ur10e": ["wrist_3_link"],
    "panda": ["panda_link0", "panda_hand", "panda_leftfinger", "panda_rightfinger", "panda_link7"],
}
LEGS = [f"{side}_{part}" for part in ("HAA", "HFE", "KFE") for side in ("LF", "LH", "RF", "RH")]
PANDA = [*(f"panda_joint{i}" for i in range(1, 8)), "panda_finger_joint1", "panda_finger_joint2"]
JOINTS: dict[str, list[str]] = {
    "anymal": LEGS,
    "shadow_hand": [
        f"robot0_{finger}J{number}"
        for finger, count in (("WR", 2), ("FF", 4), ("MF", 4), ("RF", 4), ("LF", 5), ("TH", 5))
        for number in reversed(range(count))
    ],
    "ant_instanceable": [*(f"{p}_{s}_leg" for p in ("front", "back") for s in SIDES), "front_left_foot", "front_right_foot", "left_back_foot", "right_back_foot"],
    "humanoid_instanceable": [
        "lower_waist:0", "lower_waist:1", "pelvis",
        *(f"{s}_{p}" for p in ("upper_arm:0", "upper_arm:2", "lower_arm", "thigh:0", "thigh:1", "thigh:2", "shin", "foot:0", "foot:1") for s in SIDES),
    ],
    "panda_instanceable": PANDA,
    "franka_mimic": PANDA,
}  # fmt: skip
"""Part of a path -> all joints of the robot, for tasks whose code needs their number."""
BODIES: dict[str, list[str]] = {
    "anymal": [
        "base",
        *(f"{side}_{part}" for part in ("HIP", "THIGH", "SHANK", "FOOT") for side in ("LF", "LH", "RF", "RH")),
    ],
    "cf2x": ["body", "m1_prop", "m2_prop", "m3_prop", "m4_prop"],
    "sektion_cabinet": ["sektion", "drawer_top", "drawer_handle_top", "drawer_bottom", "drawer_handle_bottom"],
    "panda_instanceable": [
        *(f"panda_link{i}" for i in range(8)),
        "panda_hand",
        "panda_leftfinger",
        "panda_rightfinger",
    ],
    "franka_mimic": [
        *(f"panda_link{i}" for i in range(8)),
        *("panda_hand", "panda_leftfinger", "panda_rightfinger", "panda_fingertip_centered", "force_sensor"),
    ],
}


def strings(pattern: str) -> list[str]:
    """Return strings that a regex matches: every alternative; an open part becomes a side at the start, else 'x'."""
    try:
        found = ["".join(parts) for parts in _expand(sre_parse.parse(pattern))]
    except Exception:
        return []
    good = [text for text in dict.fromkeys(found) if text and re.fullmatch(pattern, text)]
    return good[:64]


def _expand(parsed: Any, start: bool = True) -> Iterator[list[str]]:
    choices = []
    for number, (kind, value) in enumerate(parsed):
        choices.append(list(_options(str(kind), value, start and number == 0)))
    for parts in itertools.islice(itertools.product(*choices), 64):
        yield list(parts)


def _options(kind: str, value: Any, first: bool) -> Iterator[str]:
    if kind == "LITERAL":
        yield chr(value)
    elif kind == "ANY":
        yield "x"
    elif kind == "IN":
        for inner, what in value:
            if str(inner) == "LITERAL":
                yield chr(what)
            elif str(inner) == "RANGE":
                yield from (chr(code) for code in range(what[0], min(what[1], what[0] + 9) + 1))
            elif str(inner) == "CATEGORY":
                yield "1"
            else:
                yield "x"
    elif kind in ("MAX_REPEAT", "MIN_REPEAT"):
        low, _, inner = value
        if low == 0 and str(inner[0][0]) == "ANY":
            yield from SIDES if first else ("x",)
        elif low == 0:
            yield ""
        else:
            for parts in _expand(inner):
                yield "".join(parts) * low
    elif kind == "SUBPATTERN":
        for parts in _expand(value[3], first):
            yield "".join(parts)
    elif kind == "BRANCH":
        for branch in value[1]:
            for parts in _expand(branch, first):
                yield "".join(parts)
    elif kind in ("AT", "ASSERT", "ASSERT_NOT"):
        yield ""
    else:
        raise ValueError(kind)


def names_of(patterns: list[str]) -> list[str]:
    """Return names such that every regex matches one; fixed names come first, and none is added without need."""
    names: list[str] = []
    simple = sorted(dict.fromkeys(patterns), key=lambda p: (".*" in p, len(re.findall(r"[.*\[\](|)^?]", p))))
    for pattern in simple:
        try:
            if pattern != ".*" and (".*" not in pattern or not any(re.fullmatch(pattern, name) for name in names)):
                names += [text for text in strings(pattern) if text not in names]
        except re.error:
            continue
    return names


def collect(data: Any) -> dict[str, dict[str, list[str]]]:
    """Return entity -> joint and body regexes of all settings (nested dicts) of an environment."""
    scene = {k: v for k, v in data["scene"].items() if isinstance(v, Mapping) and "prim_path" in v}
    found = {name: {"joint": [], "body": []} for name in scene}
    prims = {
        str(item["prim_path"]).rstrip("/").rsplit("/", 1)[-1]: name
        for name, item in scene.items()
        if not any(key in item for key in ("pattern_cfg", "target_frames", "track_air_time"))
    }
    owner = {}

    def add(entity: Any, kind: str, value: Any) -> None:
        entity = owner.get(str(entity), str(entity))
        if entity in found and isinstance(value, str | list | tuple):
            values = [value] if isinstance(value, str) else list(value)
            found[entity][kind] += [v for v in values if isinstance(v, str)]

    def add_prim(path: Any) -> str | None:
        parts = [p for p in str(path).split("/") if p]
        inside = [p for p in parts if p in prims]
        if inside:
            last = inside[0]
            rest = parts[parts.index(last) + 1 :]
            if rest:
                add(prims[last], "body", rest[-1])
            return prims[last]
        return None

    for item in scene.values():
        if "data_types" in item:
            add_prim(str(item["prim_path"]).rpartition("/")[0])
    for name, item in scene.items():
        if any(key in item for key in ("pattern_cfg", "target_frames", "track_air_time")):
            entity = add_prim(item["prim_path"])
            if entity:
                owner[name] = entity
            for frame in item.get("target_frames") or ():
                add_prim(frame["prim_path"] if isinstance(frame, Mapping) else frame.prim_path)
        state = item.get("init_state") or {}
        for key in ("joint_pos", "joint_vel"):
            add(name, "joint", list((state.get(key) or {}) if isinstance(state, Mapping) else ()))
        actuators = item.get("actuators")
        for group in (actuators or {}).values() if isinstance(actuators, Mapping) else ():
            if isinstance(group, Mapping):
                add(name, "joint", group.get("joint_names_expr"))
                add(name, "body", group.get("thruster_names_expr"))
                for value in group.values():
                    if isinstance(value, Mapping):
                        add(name, "joint", list(value))

    def walk(value: Any) -> None:
        if isinstance(value, Mapping):
            if "name" in value and "body_names" in value:
                add(value["name"], "joint", value["joint_names"])
                add(value["name"], "body", value["body_names"])
            if "asset_name" in value:
                add(value["asset_name"], "joint", value.get("joint_names"))
                for key in ("body_name", "body_names"):
                    add(value["asset_name"], "body", value.get(key))
            for pair in value.get("synced_feet_pair_names") or ():  # the gait reward of Isaac Lab's Spot
                add("robot", "body", pair)
            for key in ("open_command_expr", "close_command_expr", "scale", "offset"):
                if isinstance(value.get(key), Mapping):
                    add(value.get("asset_name"), "joint", list(value[key]))
            for item in value.values():
                walk(item)
        elif isinstance(value, list | tuple):
            for item in value:
                walk(item)
        elif type(value).__name__ == "SceneEntityCfg":
            walk(vars(value))
        elif inspect.isfunction(value):
            for parameter in inspect.signature(value).parameters.values():
                walk(parameter.default)

    for item in data.get("rest", {}).items():
        for key, kind in (("finger", "body"), ("body_names", "body"), ("joint_names", "joint"), ("dof_name", "joint")):
            if key in item[0] and isinstance(item[1], str | list) and scene:
                first = next(iter(scene))
                add(first, kind, item[1])
    walk({key: value for key, value in data.items() if key != "scene"})
    return found


def moved_by_resets(data: Any) -> set[str]:
    """Return the entities whose root a reset moves."""
    found = set()
    for event in (data.get("events") or {}).values():
        params = (event.get("params") or {}) if isinstance(event, Mapping) else {}
        asset, ranges = params.get("asset_cfg"), params.get("pose_range") or {}
        if asset is not None and any(any(pair) for pair in ranges.values()):
            found.add(asset["name"] if isinstance(asset, Mapping) else asset.name)
    return found


def mjcf(
    name: str, path: str, joints: list[str], bodies: list[str], articulated: bool, driven: bool = False,
    moved: bool = False, walks: bool = False,
) -> str:  # fmt: skip
    """Return an MJCF with these joints and bodies: a chain on a fixed base, or legs on a floating one.

    `moved`: a reset moves the base. `walks`: a velocity is commanded to the base.
    """
    if not articulated:
        parts = "".join(
            f'<body name="{b}" pos="0 0 {0.05 * i}"><geom size="0.02"/></body>' for i, b in enumerate(bodies)
        )
        return f'<mujoco><worldbody><body name="{name}"><freejoint/><geom type="box" size=".03 .03 .03"/>{parts}</body></worldbody></mujoco>'
    floating = walks or any(word in path.lower() for word in FLOATING)
    root_words = ("base", "trunk", "torso", "pelvis", "body", "root", "link0", "base_link", "torso_link")
    root = next((b for word in root_words for b in bodies if b == word), None)
    root = (
        root
        or next((b for b in bodies if "base" in b or "pelvis" in b), None)
        or ("base" if joints else (bodies or [name])[0])
    )
    rest = [b for b in bodies if b != root]
    owned = {joint: (rest.pop(0) if rest else f"part_{number}") for number, joint in enumerate(joints)}
    fixed = "".join(
        f'<body name="{b}" pos="{0.1 * (i % 5)} {0.1 * (i // 5)} -0.1"><geom size="0.02" mass="0.05"/></body>'
        for i, b in enumerate(rest)
    )
    inner = ""
    for number, joint in enumerate(joints if floating else reversed(joints)):
        kind = (
            "slide" if any(word in joint.lower() for word in ("finger", "slider", "prismatic", "drawer")) else "hinge"
        )
        limits = "0 0.08" if kind == "slide" else "-2 2"
        if "cart" in joint:
            limits = "-4 4"
        axis = "0 1 0" if number % 2 else "0 0 1"
        place = f"{0.1 * (number % 5 - 2)} {0.1 * (number // 5 % 5 - 2)} 0" if floating else "0.05 0 0.1"
        start = f'<body name="{owned[joint]}" pos="{place}"><joint name="{joint}" type="{kind}" axis="{axis}" range="{limits}" damping="1" armature="0.5"/>'
        start += '<geom size="0.06" pos="0 0 -0.1" mass="1"/>'
        inner = inner + start + "</body>" if floating else f"{start}{inner}</body>"
    drives = "".join(f'<position name="{joint}" joint="{joint}" kp="30" kv="1"/>' for joint in joints if driven)
    motors = f"<actuator>{drives}</actuator>" if driven else ""
    free = "<freejoint/>" if floating else ""
    mocap = ' mocap="true"' if moved and not floating else ""
    if "shadow" in path.lower() and len(joints) > 1:
        motors += f'<tendon><fixed name="tendon"><joint joint="{joints[0]}" coef="1"/><joint joint="{joints[1]}" coef="-1"/></fixed></tendon>'
    return (
        f'<mujoco model="{name}"><compiler angle="radian"/><worldbody><body name="{root}"{mocap}>{free}'
        f'<geom type="box" size=".15 .1 .05" mass="20"/>{inner}{fixed}</body></worldbody>{motors}</mujoco>'
    )


def write(data: Any, folder: Path) -> None:
    """Write stand-in models of all entities that have a file, and `models.yaml`, which names them."""
    folder.mkdir(parents=True, exist_ok=True)
    scene = dict(data["scene"])
    for name, item in data["scene"].items():
        for part, content in (item.get("rigid_objects") or {}).items() if isinstance(item, Mapping) else ():
            scene[f"{name}_{part}"] = content
    data = {**data, "scene": scene}
    lines = []
    for name, wanted in collect(data).items():
        item = data["scene"][name]
        spawn = item.get("spawn")
        if not isinstance(spawn, Mapping) or not any(spawn.get(k) for k in ("usd_path", "asset_path", "assets_cfg")):
            continue
        path = str(spawn.get("usd_path") or spawn.get("asset_path"))
        extra = [b for word, names in EXTRA_BODIES.items() if word in path.lower() for b in names]
        groups = item.get("actuators")
        values = list(groups.values()) if isinstance(groups, Mapping) else []
        driven = any(
            isinstance(a, Mapping) and a.get("stiffness", 0) is None and "network_file" not in a for a in values
        )
        joints, bodies = names_of(wanted["joint"]), names_of([*wanted["body"], *extra])
        for table, target in ((JOINTS, joints), (BODIES, bodies)):
            for word, names in table.items():
                if word in path.lower():
                    target[:] = names
        articulated = bool(item.get("actuators")) or bool(wanted["joint"])
        walks = any(
            "ang_vel_z" in (command.get("ranges") or {}) and command.get("asset_name") == name
            for command in (data.get("commands") or {}).values()
            if isinstance(command, Mapping)
        )
        text = mjcf(name, path, joints, bodies, articulated, driven, name in moved_by_resets(data), walks)
        (folder / f"{name}.xml").write_text(text)
        networks = [g for g, a in groups.items() if "network_file" in a] if isinstance(groups, Mapping) else []
        gains = ", ".join(f"{group}: {{stiffness: 40.0, damping: 2.0}}" for group in networks)
        lines.append(f"{name}: {{model: {name}.xml, gains: {{{gains}}}}}")
    (folder / "models.yaml").write_text("\n".join(lines) + "\n")

"""MJCF stand-ins for the robots and objects of OmniIsaacGymEnvs that have no built-in model.

They have the joint and body names that the tasks use, and simple shapes. A task runs with them, but what it learns says
nothing about the original robot.
"""

from pathlib import Path

HEAD = '<mujoco model="{name}"><compiler angle="radian"/><option integrator="implicitfast"/>{default}<worldbody>'
QUADRANTS = {"LF": (0.3, 0.2), "LH": (-0.3, 0.2), "RF": (0.3, -0.2), "RH": (-0.3, -0.2)}
FINGERS = ("FF", "MF", "RF", "LF")


def body(
    name: str, inner: str, pos: str = "0 0 0", joint: str = "", axis: str = "0 1 0", span: str = "-1.5 1.5"
) -> str:
    """Return a body with one joint (slide: its name has the prefix `slide:`)."""
    kind, _, label = joint.rpartition(":")
    text = f'<body name="{name}" pos="{pos}">'
    if label:
        text += f'<joint name="{label}" type="{kind or "hinge"}" axis="{axis}" range="{span}" limited="true"'
        text += ' armature="0.01" damping="0.05"/>'
    return f"{text}{inner}</body>"


def geom(size: str = "0.02", mass: float = 0.1, pos: str = "0 0 0", kind: str = "sphere", solid: bool = True) -> str:
    """Return a geom."""
    collide = "" if solid else ' contype="0" conaffinity="0"'
    return f'<geom type="{kind}" size="{size}" mass="{mass}" pos="{pos}"{collide}/>'


def model(name: str, bodies: str, after: str = "", default: str = "") -> str:
    """Return a whole model."""
    return f"{HEAD.format(name=name, default=default)}{bodies}</worldbody>{after}</mujoco>"


def anymal() -> str:
    legs = ""
    for side, (x, y) in QUADRANTS.items():
        shank = body(f"{side}_SHANK", geom("0.03", 0.5, "0 0 -0.32"), "0 0.05 -0.25", f"{side}_KFE", span="-3 3")
        thigh = body(f"{side}_THIGH", geom("0.04", 1.5) + shank, "0.05 0 0", f"{side}_HFE", span="-3 3")
        legs += body(f"{side}_HIP", geom("0.05", 1.5) + thigh, f"{x} {y} 0", f"{side}_HAA", "1 0 0", "-1 1")
    return model("anymal", body("base", "<freejoint/>" + geom("0.3 0.15 0.1", 16.0, kind="box") + legs))


def balance_bot() -> str:
    legs = ""
    for number, (x, y) in enumerate([(0.4, 0.0), (-0.2, 0.34641), (-0.2, -0.34641)]):
        lower = body(f"lower_leg{number}", geom("0.02", 0.3, "0 0 0.1", solid=False), "0 0 -0.36", f"lower_leg{number}")
        upper = geom("0.02", 0.3, solid=False) + lower
        legs += body(f"upper_leg{number}", upper, f"{x} {y} -0.1", f"upper_leg{number}")
    return model("balance_bot", body("tray", "<freejoint/>" + geom("0.5 0.01", 2.0, kind="cylinder") + legs))


def franka() -> str:
    fingers = "".join(
        body(f"panda_{side}finger", geom("0.01 0.01 0.02", 0.05, kind="box"), "0 0 0.058",
             f"slide:panda_finger_joint{n}", axis, "0 0.04")
        for n, side, axis in ((1, "left", "0 1 0"), (2, "right", "0 -1 0"))
    )  # fmt: skip
    inner = body("panda_hand", geom("0.03", 0.5) + fingers, "0 0 0.107")
    limits = ("-2.9 2.9", "-1.8 1.8", "-2.9 2.9", "-3.1 0", "-2.9 2.9", "0 3.8", "-2.9 2.9")
    axes = ("0 0 1", "0 1 0", "0 0 1", "0 -1 0", "0 0 1", "0 -1 0", "0 0 -1")
    heights = (0.333, 0.0, 0.316, 0.0, 0.384, 0.0, -0.1)
    for number in range(7, 0, -1):
        place, label = f"0 0 {heights[number - 1]}", f"panda_joint{number}"
        inner = body(f"panda_link{number}", geom("0.05", 2.0, solid=False) + inner, place, label, axes[number - 1],
                     limits[number - 1])  # fmt: skip
    return model("franka", body("panda_link0", geom("0.08", 3.0) + inner))


def cabinet() -> str:
    parts = [
        ("door_left", "door_left_joint", "0 0 1", "0 1.5"), ("door_right", "door_right_joint", "0 0 -1", "0 1.5"),
        ("drawer_bottom", "slide:drawer_bottom_joint", "1 0 0", "0 0.4"),
        ("drawer_top", "slide:drawer_top_joint", "1 0 0", "0 0.4"),
    ]  # fmt: skip
    inner = "".join(
        body(name, geom("0.02 0.2 0.05", 1.0, "0.3 0 0", "box"), f"0 0 {0.15 * number - 0.1}", joint, axis, span)
        for number, (name, joint, axis, span) in enumerate(parts)
    )
    return model("cabinet", body("sektion", geom("0.25 0.3 0.02", 20.0, "0 0 -0.35", "box") + inner))


def allegro_hand() -> str:
    names = [[f"{finger}_joint_{n}" for n in range(4)] for finger in ("index", "middle", "ring", "thumb")]
    fingers, drives = "", ""
    for number, joints in enumerate(names):
        chain = ""
        for n, joint in reversed(list(enumerate(joints))):
            place = f"0 {0.05 * number - 0.075} 0.05" if n == 0 else "0 0 0.04"
            chain = body(joint.replace("joint", "link"), geom("0.012", 0.03) + chain, place, joint, span="-0.4 1.6")
            drives += f'<position name="{joint}" joint="{joint}" kp="3" kv="0.1" forcerange="-0.5 0.5"/>'
        fingers += chain
    palm = body("palm_link", geom("0.04 0.06 0.02", 0.5, kind="box") + fingers)
    return model("allegro_hand", palm, f"<actuator>{drives}</actuator>")


def shadow_hand() -> str:
    fingers, tendons = "", ""
    for number, finger in enumerate((*FINGERS, "TH")):
        count = 5 if finger in ("LF", "TH") else 4
        links = ["distal", "middle", "proximal", "knuckle", "metacarpal"][:count]
        if finger == "TH":
            links = ["distal", "middle", "hub", "proximal", "base"]
        chain = ""
        for n, link in enumerate(links):
            place = f"{0.03 * number - 0.06} -0.1 0" if n == count - 1 else "0 -0.03 0"
            name = f"robot0_{finger.lower()}{link}"
            chain = body(name, geom("0.01", 0.02) + chain, place, f"robot0_{finger}J{n}", "1 0 0", "-0.3 1.5")
        fingers += chain
        if finger != "TH":
            pair = "".join(f'<joint joint="robot0_{finger}J{n}" coef="{c}"/>' for n, c in ((1, 1), (0, -1)))
            tendons += f'<fixed name="robot0_T_{finger}J1c">{pair}</fixed>'
    palm = body("robot0_palm", geom("0.05 0.06 0.01", 0.3, "0 -0.05 0", "box") + fingers, "0 -0.03 0", "robot0_WRJ0",
                "1 0 0", "-0.7 0.5")  # fmt: skip
    wrist = body("robot0_wrist", geom("0.02", 0.1) + palm, "0 -0.2 0", "robot0_WRJ1", "0 0 1", "-0.5 0.2")
    arm = body("robot0_forearm", geom("0.03", 1.0) + wrist)
    return model("shadow_hand", body("robot0_hand_mount", geom("0.03", 1.0) + arm), f"<tendon>{tendons}</tendon>")


def block() -> str:
    return model("block", body("object", "<freejoint/>" + geom("0.0325 0.0325 0.0325", 0.07, kind="box")))


def carter() -> str:
    wheels = "".join(
        body(f"wheel_{side}", geom("0.135", 1.0, solid=True), f"0 {y} 0", f"joint_wheel_{side}", span="-1e6 1e6")
        for side, y in (("left", 0.168), ("right", -0.168))
    )
    caster = geom("0.06", 1.0, "-0.3 0 -0.075")
    inner = "<freejoint/>" + geom("0.25 0.15 0.1", 30.0, "0 0 0.1", "box") + caster + wheels
    eye = '<camera name="camera_sensor_right" pos="0.2 0 0.2" xyaxes="0 -1 0 0 0 1"/>'
    return model("carter", body("chassis_link", inner + eye))


def cube() -> str:
    return model("cube", body("NvidiaCube", "<freejoint/>" + geom("0.125 0.125 0.125", 1.0, kind="box")))


MODELS = {
    "anymal": anymal, "BalanceBot": balance_bot, "franka": franka, "cabinet": cabinet, "allegro_hand": allegro_hand,
    "shadow_hand": shadow_hand, "block_instanceable": block, "CarterV2": carter, "NvidiaCube": cube,
}  # fmt: skip
"""Name of a robot or object, as `--model` expects it -> function that returns its model."""


def write(folder: Path) -> dict[str, Path]:
    """Write the models to a folder, and return the file of each name."""
    files = {}
    for name, make in MODELS.items():
        files[name] = folder / f"{name}.xml"
        files[name].write_text(make(), encoding="utf-8")
    return files

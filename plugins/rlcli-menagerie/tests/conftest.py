"""Stand-in models with the body and joint names of the real robots."""

import pytest
import torch

torch.set_num_threads(1)

LEG = """
    <body name="{n}_hip" pos="{x} {y} 0"><joint name="{n}_hip_joint" axis="1 0 0" range="-0.9 0.9"/>
      <geom type="sphere" size="0.03" mass="0.7"/>
      <body name="{n}_thigh" pos="0 {side} 0"><joint name="{n}_thigh_joint" axis="0 1 0" range="-0.7 4.5"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.2" mass="1"/>
        <body name="{n}_calf" pos="0 0 -0.21"><joint name="{n}_calf_joint" axis="0 1 0" range="-2.8 -0.9"/>
          <geom type="capsule" size="0.015" fromto="0 0 0 0 0 -0.19" mass="0.1"/>
          <geom name="{n}" type="sphere" size="0.02" pos="0 0 -0.21" mass="0.1"/>
        </body></body></body>"""


@pytest.fixture
def go1_mjcf():
    """Return the function that writes the MJCF of the four-legged robot."""
    return go1


def go1(driven: bool) -> str:
    """Return a four-legged robot, with position actuators as in Menagerie's file, or without any as in mjlab's."""
    places = {"FR": (1, -1), "FL": (1, 1), "RR": (-1, -1), "RL": (-1, 1)}
    legs = "".join(LEG.format(n=n, x=0.19 * x, y=0.047 * y, side=0.08 * y) for n, (x, y) in places.items())
    joints = [f"{name}_{part}_joint" for name in places for part in ("hip", "thigh", "calf")]
    drives = "".join(f'<position name="{j[:-6]}" joint="{j}" kp="100" forcerange="-23 23"/>' for j in joints)
    actuators = f"<actuator>{drives}</actuator>" if driven else ""
    key = f'<keyframe><key name="home" qpos="0 0 0.27 1 0 0 0 {"0 0.9 -1.8 " * 4}"/></keyframe>' if driven else ""
    return (
        '<mujoco model="go1"><compiler angle="radian" autolimits="true"/><worldbody>'
        '<body name="trunk" pos="0 0 0.445"><freejoint/><geom type="box" size="0.13 0.09 0.05" mass="5.2"/>'
        f"{legs}</body></worldbody>{actuators}{key}</mujoco>"
    )


def _chain(names: list[tuple[str, str, str, str]], inside: str) -> str:
    for body, joint, axis, pos in reversed(names):
        shape = '<geom type="box" size="0.09 0.03 0.02" pos="0.03 0 -0.03" mass="0.6"/>' if "ankle_roll" in body else ""
        shape = shape or '<geom type="sphere" size="0.03" mass="1" contype="0" conaffinity="0"/>'
        hinge = f'<joint name="{joint}" axis="{axis}" range="-2.6 2.6"/>'
        inside = f'<body name="{body}" pos="{pos}">{hinge}{shape}{inside}</body>'
    return inside


def g1() -> str:
    """Return a humanoid with 29 joints."""
    x, y, z = "1 0 0", "0 1 0", "0 0 1"
    limbs = ""
    for side, sign in (("left", 1), ("right", -1)):
        leg = [("hip_pitch", y, f"0 {0.08 * sign} -0.1"), ("hip_roll", x, f"0 {0.04 * sign} -0.03"),
               ("hip_yaw", z, "0 0 -0.1"), ("knee", y, "0 0 -0.19"), ("ankle_pitch", y, "0 0 -0.3"),
               ("ankle_roll", x, "0 0 -0.02")]  # fmt: skip
        limbs += _chain([(f"{side}_{n}_link", f"{side}_{n}_joint", axis, pos) for n, axis, pos in leg], "")
    arms = ""
    for side, sign in (("left", 1), ("right", -1)):
        arm = [("shoulder_pitch", y, f"0 {0.1 * sign} 0.25"), ("shoulder_roll", x, f"0 {0.04 * sign} 0"),
               ("shoulder_yaw", z, "0 0 -0.1"), ("elbow", y, "0 0 -0.08"), ("wrist_roll", x, "0.1 0 0"),
               ("wrist_pitch", y, "0.04 0 0"), ("wrist_yaw", z, "0.05 0 0")]  # fmt: skip
        arms += _chain([(f"{side}_{n}_link", f"{side}_{n}_joint", axis, pos) for n, axis, pos in arm], "")
    waist = [("waist_yaw_link", "waist_yaw_joint", z, "0 0 0"), ("waist_roll_link", "waist_roll_joint", x, "0 0 0.04"),
             ("torso_link", "waist_pitch_joint", y, "0 0 0")]  # fmt: skip
    return (
        '<mujoco model="g1"><compiler angle="radian" autolimits="true"/><worldbody><body name="pelvis" pos="0 0 0.793">'
        '<freejoint name="floating_base_joint"/><geom type="sphere" size="0.07" mass="4"/>'
        f"{limbs}{_chain(waist, arms)}</body></worldbody></mujoco>"
    )


@pytest.fixture
def models(tmp_path, monkeypatch):
    """Return a folder with the layout of MuJoCo Menagerie and the stand-in models."""
    folder = tmp_path / "models"
    for robot, text in (("unitree_go1/go1", go1(driven=True)), ("unitree_g1/g1", g1())):
        file = folder / f"{robot}.xml"
        file.parent.mkdir(parents=True)
        file.write_text(text)
    monkeypatch.setenv("RLCLI_MODELS", str(folder))
    return folder

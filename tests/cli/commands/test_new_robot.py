"""`rlcli new --robot`: what a task for the robot of an MJCF contains, and refused files."""

import re
import shutil
import struct

import mujoco
import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from rlcli.api import make

pytestmark = pytest.mark.usefixtures("empty_folder")

LEG = (
    '<body pos="{x} {y} 0"><joint type="hinge" axis="0 1 0" range="-60 60"/><geom type="capsule" size="0.02"'
    ' fromto="0 0 0 0 0 -0.2" mass="0.2"/></body>'
)
DOG = (
    '<mujoco><worldbody><light pos="0 0 3"/><geom type="plane" size="5 5 1"/>'
    '<body name="trunk" pos="0 0 0.7"><freejoint name="root"/><geom type="box" size="0.2 0.1 0.05" mass="4"/>'
    + "".join(LEG.format(x=x, y=y) for x in (-0.2, 0.2) for y in (-0.1, 0.1))
    + "</body></worldbody></mujoco>"
)
CART = """<mujoco><worldbody><body name="cart"><joint name="slide" type="slide" axis="1 0 0"/>
<geom type="box" size="0.1 0.1 0.05" mass="1"/><body name="pole"><joint name="hinge" axis="0 1 0"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.6" mass="0.1"/></body></body></worldbody>
<actuator><motor joint="slide" gear="10" ctrlrange="-1 1" ctrllimited="true"/></actuator>
<keyframe><key name="home" qpos="0.3 0"/></keyframe></mujoco>"""
POLE = """<body pos="0 0 0.6"><joint name="second" axis="0 1 0"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.4" mass="0.1"/></body>"""
ARM = """<mujoco><worldbody><body name="upper"><joint name="a" axis="0 1 0" range="-90 90"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.4" mass="0.5"/><body name="lower" pos="0 0 0.4">
<joint name="b" axis="1 0 0" range="-90 90"/><geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.3" mass="0.3"/>
<body name="hand" pos="0 0 0.3"><joint name="c" axis="0 1 0" range="-90 90"/><geom size="0.03" mass="0.1"/></body>
</body></body></worldbody><actuator><position joint="a" kp="20" forcerange="-9 9"/><motor joint="b" gear="5"
ctrlrange="-1 1" ctrllimited="true"/><motor joint="c" gear="2" ctrlrange="-1 1" ctrllimited="true"/></actuator></mujoco>
"""
POINT = """<mujoco><worldbody><body name="point" pos="1 0 0" euler="0 0 90"><joint name="x" type="{kind}" axis="1 0 0"/>
<joint name="y" type="{kind}" axis="0 1 0"/><geom size="0.1" mass="1"/></body></worldbody></mujoco>"""
UNICYCLE = """<mujoco><worldbody><body name="frame" pos="0 0 0.15"><freejoint/>
<geom type="capsule" fromto="0 0 0.15 0 0 0.5" size="0.03" mass="2"/><body><joint name="drive" axis="0 1 0"/>
<geom type="ellipsoid" size="0.15 0.03 0.15" mass="1"/></body><body pos="0.06 0 0.5"><joint name="fly" axis="1 0 0"/>
<geom type="cylinder" fromto="-0.01 0 0 0.01 0 0" size="0.2" mass="1.5" contype="0" conaffinity="0"/></body></body>
</worldbody><actuator><motor joint="drive" ctrlrange="-6 6"/><motor joint="fly" ctrlrange="-8 8"/></actuator></mujoco>
"""


def written(cli, tmp_path, text):
    (tmp_path / "robot.xml").write_text(text)
    result = cli("new", "my-robot", "--robot", "robot.xml", "--json")
    assert result.code == 0, result.err
    valid = cli("validate", "my-robot/my_robot")
    assert valid.code == 0, valid.err
    return result, yaml.safe_load((tmp_path / "my-robot" / "my_robot" / "task.yaml").read_text())


def test_floating_base_tracks_velocities(cli, tmp_path):
    result, task = written(cli, tmp_path, DOG)
    assert result.json["flavour"] == "velocity"
    assert "5 joints: root, (unnamed)" in result.err
    robot = task["scene"]["entities"]["robot"]
    assert robot["pos"][2] == pytest.approx(0.2205, abs=0.0002)  # the legs just touch the ground
    assert len(robot["joints"]) == 4  # the file has no actuators
    assert len(task["scene"]["sensors"]["feet"]["bodies"]) == 4
    assert task["scene"]["sensors"]["trunk"]["bodies"] == ["trunk"]
    model = (tmp_path / "my-robot" / "my_robot" / "model.xml").read_text()
    assert "plane" not in model
    assert "<light" not in model


def test_other_robot_balances_about_its_keyframe(cli, tmp_path):
    _, task = written(cli, tmp_path, CART)
    assert task["actions"]["effort"]["scale"] == {"slide": 10.0}
    assert task["scene"]["entities"]["robot"]["init"] == {"joint_pos": {"slide": 0.3}}
    assert task["success"]["pose"]["joints"] == ["hinge"]


def test_floating_base_with_wheels_is_kept_upright(cli, tmp_path):
    _, task = written(cli, tmp_path, UNICYCLE)
    observed = ["base_lin_vel", "base_ang_vel", "projected_gravity", "wheel_vel"]  # the angle of a wheel says nothing
    assert list(task["observations"]["policy"]) == observed
    assert list(task["rewards"]) == ["alive", "upright", "wheel_speed", "effort", "fall"]
    assert task["events"]["root"]["roll"] == task["events"]["root"]["pitch"] == [-0.05, 0.05]
    assert list(task["success"]) == ["upright"]


def test_flywheel_on_a_fixed_base_has_no_pose_to_hold(cli, tmp_path):
    wheel = POLE.replace("second", "fly").replace("0 0 0 0 0 0.4", "0 0 -0.2 0 0 0.2")
    text = CART.replace("</body></body></worldbody>", wheel + "</body></body></worldbody>").replace("0.3 0", "0.3 0 0")
    _, task = written(cli, tmp_path, text)
    assert task["success"]["pose"]["joints"] == ["hinge"]
    assert task["rewards"]["pose"]["joints"] == ["hinge"]
    assert task["rewards"]["speed"]["joints"] == ["slide", "hinge"]
    assert task["rewards"]["wheel_speed"]["joints"] == ["fly"]


def test_joints_with_different_defaults_have_a_condition_each(cli, tmp_path):
    text = CART.replace("</body></body></worldbody>", POLE + "</body></body></worldbody>").replace("0.3 0", "0.3 0 0.5")
    _, task = written(cli, tmp_path, text)
    targets = {tuple(each["joints"]): each["target"] for each in task["success"].values()}
    assert targets == {("hinge",): 0.0, ("second",): 0.5}


def test_joints_of_an_object_are_no_passive_joints_of_the_arm(cli, tmp_path):
    box = (
        '<body name="box" pos="1 0 0"><joint name="x" type="slide" axis="1 0 0"/><geom size="0.05"/></body></worldbody>'
    )
    _, task = written(cli, tmp_path, ARM.replace("</worldbody>", box))
    goal = task["commands"]["goal"]
    assert (goal["func"], goal["bodies"], goal["joints"]) == ("reachable_position", "hand", ["a", "b", "c"])
    assert "x" not in str(task["observations"])


def test_fixed_base_reaches_with_its_last_body(cli, tmp_path):
    _, task = written(cli, tmp_path, ARM)
    goal = task["commands"]["goal"]
    assert (goal["func"], goal["bodies"], goal["joints"]) == ("reachable_position", "hand", ["a", "b", "c"])
    assert task["actions"]["joint_position"]["scale"] == {"a": 0.785, "b": 0.785, "c": 0.785}
    assert task["success"]["position"]["at_most"] == pytest.approx(0.025 * 1.2, rel=0.2)  # goals are within 1.2 m
    # gains of the motors follow from their efforts; the position actuator keeps its own
    joints = task["scene"]["entities"]["robot"]["joints"]
    assert {name: values["effort_limit"] for name, values in joints.items()} == {"b": 5.0, "c": 2.0}


@pytest.mark.parametrize("text", [ARM, POINT.format(kind="slide")], ids=["arm", "point"])
def test_untrained_policies_seldom_reach_the_goals(cli, tmp_path, text):
    written(cli, tmp_path, text)
    for policy in ("zero", "random"):
        result = cli(
            "eval", "my-robot/my_robot", "--policy", policy, "--episodes", "300", "--num-envs", "300", "--json"
        )
        assert result.code == 0, result.err
        assert result.json["success"]["rate"] <= 0.02


@pytest.mark.parametrize("size", [1.0, 0.2])
def test_an_arm_reaches_its_goals_if_its_joints_are_at_their_targets(cli, tmp_path, size):
    """Gravity displaces the hand by less than the tolerance of the success, for arms of any size."""
    text = ARM[: ARM.index("<actuator>")] + "</mujoco>"
    for length in ("0.4", "0.3", "0.02", "0.03"):
        text = re.sub(rf"\b{length}\b", f"{float(length) * size:g}", text)
    _, task = written(cli, tmp_path, text)
    env, generator = make("my-robot/my_robot", num_envs=64), np.random.default_rng(0)
    model = mujoco.MjModel.from_xml_path("my-robot/my_robot/model.xml")
    plan, hands, targets = mujoco.MjData(model), [], generator.uniform(-1.0, 1.0, (64, 3))
    for angles in targets:
        plan.qpos[:] = angles
        mujoco.mj_kinematics(model, plan)
        hands.append(plan.body("hand").xpos.copy())
    env.reset()
    scales = [task["actions"]["joint_position"]["scale"][name] for name in "abc"]
    for _ in range(100):
        env.step(torch.tensor(targets / scales, dtype=torch.float32))
    goal = env.command_manager.get_term("goal")
    goal.command.copy_(torch.tensor(np.array(hands)))
    env.step(torch.tensor(targets / scales, dtype=torch.float32))
    assert float(goal.metrics()["position_error"].quantile(0.9)) < task["success"]["position"]["at_most"]


def test_an_arm_without_a_keyframe_starts_away_from_its_limits(cli, tmp_path):
    text = ARM.replace('axis="1 0 0" range="-90 90"', 'axis="1 0 0" range="0 150"')
    _, task = written(cli, tmp_path, text)
    assert task["scene"]["entities"]["robot"]["init"] == {"joint_pos": {"b": 1.31}}
    shutil.rmtree(tmp_path / "my-robot")
    _, task = written(cli, tmp_path, text.replace("</mujoco>", '<keyframe><key qpos="0 0.1 0"/></keyframe></mujoco>'))
    assert task["scene"]["entities"]["robot"]["init"] == {"joint_pos": {"b": 0.1}}


def test_a_finger_that_follows_another_one_is_not_driven(cli, tmp_path):
    finger = (
        '<body pos="0 {y} 0"><joint name="{name}" type="slide" axis="0 1 0" range="-0.04 0"/><geom size="0.01"/></body>'
    )
    fingers = finger.format(y=0.05, name="left") + finger.format(y=-0.05, name="right")
    text = ARM[: ARM.index("<actuator>")].replace("</body>\n</body></body>", fingers + "</body>\n</body></body>")
    tie = '<equality><joint joint1="right" joint2="left" polycoef="0 -1 0 0 0"/></equality></mujoco>'
    result, task = written(cli, tmp_path, text + tie)
    assert result.json["flavour"] == "reach"
    assert task["actions"]["joint_position"]["joints"] == ["a", "b", "c", "left"]
    assert task["scene"]["entities"]["robot"]["init"]["joint_pos"] == {"left": -0.02, "right": 0.02}


def test_only_reaching_changes_the_usual_time_step(cli, tmp_path):
    for text, expected in (
        (ARM, (0.005, 4)),
        (ARM.replace("<worldbody>", '<option timestep="0.001"/><worldbody>'), (0.001, 20)),
        (ARM.replace('kp="20"', 'kp="90000"'), (0.002, 10)),  # a servo that is too fast for a longer step
        (DOG, (0.002, 10)),
    ):
        _, task = written(cli, tmp_path, text)
        assert (task["sim"]["dt"], task["decimation"]) == expected
        shutil.rmtree(tmp_path / "my-robot")


def test_the_reason_for_the_kind_is_printed(cli, tmp_path):
    for text, kind, reason in (
        (DOG, "velocity", "the robot's base floats, and it has 4 feet and 4 driven joints"),
        (
            CART,
            "balance",
            "the robot's base is fixed (no free joint), but 1 of its joints has no actuator of its own (hinge)",
        ),
        (ARM, "reach", "the robot's base is fixed (no free joint), and all 3 joints are driven"),
        (POINT.format(kind="hinge"), "balance", "the joints do not move the last body 'point' by more than 1 cm"),
        (UNICYCLE, "balance", "only 2 driven joints"),
        (DOG.replace("<worldbody>", '<option gravity="0 0 0"/><worldbody>'), "balance", "the file sets gravity to 0"),
        (
            DOG.replace("<worldbody>", '<option><flag gravity="disable"/></option><worldbody>'),
            "balance",
            "the file sets gravity to 0",
        ),
        (
            DOG.replace("<worldbody>", '<option><flag constraint="disable"/></option><worldbody>'),
            "balance",
            "the file turns contacts with the ground off",
        ),
        (DOG.replace("<geom ", '<geom contype="2" '), "velocity", "4 feet"),
        (DOG.replace("0 0 0 0 0 -0.2", "0 0 -0.03 0.2 0 -0.03"), "balance", "the trunk touches the ground"),
        (
            DOG.replace("<geom ", '<geom contype="2" conaffinity="2" '),
            "balance",
            "the file turns contacts with the ground off",
        ),
    ):
        result, _ = written(cli, tmp_path, text)
        assert f"task: {kind}, because" in result.err
        assert reason in result.err
        shutil.rmtree(tmp_path / "my-robot")


def test_the_kind_can_be_chosen(cli, tmp_path):
    (tmp_path / "robot.xml").write_text(CART)
    result = cli("new", "my-robot", "--robot", "robot.xml", "--kind", "reach", "--json")
    assert (result.code, result.json["flavour"]) == (0, "reach")
    assert "task: reach, because --kind says so; without --kind balance" in result.err
    assert cli("validate", "--deep", "my-robot/my_robot").code == 0
    for kind, message in (
        ("velocity", "impossible for robot.xml: the robot's base is fixed"),
        ("walk", "no kind of task 'walk'"),
    ):
        refused = cli("new", "other-robot", "--robot", "robot.xml", "--kind", kind)
        assert (refused.code, message in refused.err) == (2, True), refused.err
    assert "--kind needs --robot" in cli("new", "other-robot", "--kind", "reach").err


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<worldbody>", '<compiler angle="radian"/><worldbody>', "joint 'a' has the limits -90 to 90 rad"),
        ('range="-90 90"', 'range="-1.5 1.5"', "no hinge with limits turns further than 6.28 degrees"),
        ("</mujoco>", '<keyframe><key qpos="0 45 0"/></keyframe></mujoco>', "has joint 'b' at 45 rad"),
    ],
)
def test_angles_in_a_wrong_unit_are_reported(cli, tmp_path, old, new, message):
    result, _ = written(cli, tmp_path, ARM.replace(old, new))
    assert message in result.err


def test_default_pose_is_that_of_numeric_init_qpos(cli, tmp_path):
    start = '<custom><numeric name="init_qpos" data="0 0 1 1 0 0 0 0.5 0.5 0.5 0.5"/></custom>'
    _, task = written(cli, tmp_path, DOG.replace("</mujoco>", start + "</mujoco>"))
    assert list(task["scene"]["entities"]["robot"]["init"]["joint_pos"].values()) == [0.5] * 4


def test_loose_object_and_terrain_do_not_lift_the_robot(cli, tmp_path):
    ball = '<body name="ball" pos="2 0 3"><freejoint/><geom size="0.1"/></body></worldbody>'
    field = '<geom type="hfield" hfield="h"/><light'
    text = DOG.replace("</worldbody>", ball).replace("<light", field)
    text = text.replace("<worldbody>", '<asset><hfield name="h" nrow="3" ncol="3" size="9 9 2 1"/></asset><worldbody>')
    _, task = written(cli, tmp_path, text)
    assert task["scene"]["entities"]["robot"]["pos"][2] == pytest.approx(0.2205, abs=0.0002)


def test_root_whose_z_axis_is_not_up_gets_a_level_parent(cli, tmp_path):
    _, task = written(cli, tmp_path, DOG.replace('name="trunk"', 'name="trunk" euler="90 0 0"'))
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "my-robot" / "my_robot" / "model.xml"))
    assert model.body("trunk_level").dofnum == 6
    assert model.body("trunk_level").quat.tolist() == [1.0, 0.0, 0.0, 0.0]
    assert model.body("trunk").quat.tolist() == pytest.approx([0.7071, 0.7071, 0.0, 0.0], abs=1e-4)
    assert task["scene"]["sensors"]["trunk"]["bodies"] == ["trunk"]


def test_mocap_body_does_not_hold_the_robot(cli, tmp_path):
    mocap = '<body name="target" mocap="true"/></worldbody><equality><weld body1="target" body2="hand"/></equality>'
    written(cli, tmp_path, ARM.replace("</worldbody>", mocap))
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "my-robot" / "my_robot" / "model.xml"))
    assert (model.nmocap, model.neq) == (1, 0)


def test_joint_locked_by_its_damping_is_not_driven(cli, tmp_path):
    text = ARM[: ARM.index("<actuator>")].replace('name="a"', 'name="a" damping="1e11"') + "</mujoco>"
    result, task = written(cli, tmp_path, text)
    assert result.json["flavour"] == "reach"
    assert task["actions"]["joint_position"]["joints"] == ["b", "c"]
    assert list(task["scene"]["entities"]["robot"]["joints"]) == ["b", "c"]


def test_gravity_of_the_file_is_kept(cli, tmp_path):
    _, task = written(cli, tmp_path, ARM.replace("<worldbody>", '<option gravity="0 0 0"/><worldbody>'))
    assert task["sim"]["gravity"] == [0.0, 0.0, 0.0]


def test_gravity_that_a_flag_turns_off_can_be_set_in_the_task(cli, tmp_path):
    text = DOG.replace("<worldbody>", '<option><flag gravity="disable"/></option><worldbody>')
    _, task = written(cli, tmp_path, text)
    assert task["sim"]["gravity"] == [0.0, 0.0, 0.0]
    path = tmp_path / "my-robot" / "my_robot"
    for gravity, falls in ((0.0, False), (-9.81, True)):
        task["sim"]["gravity"][2] = gravity
        (path / "task.yaml").write_text(yaml.safe_dump(task))
        env = make("my-robot/my_robot", num_envs=1)
        env.reset()
        start = float(env.engine.field("qpos")[0, 2])
        for _ in range(20):
            env.step(torch.zeros(1, 4))
        assert (float(env.engine.field("qpos")[0, 2]) < start - 0.01) == falls


def test_solver_that_the_gpu_engine_lacks_is_replaced(cli, tmp_path):
    result, _ = written(cli, tmp_path, DOG.replace("<worldbody>", '<option solver="PGS"/><worldbody>'))
    assert "the copy of the model has the solver Newton instead of PGS" in result.err
    env = make("my-robot/my_robot", num_envs=2, overrides=["sim.engine=warp"])
    env.reset()
    assert bool(env.step(torch.zeros(2, 4)).reward.isfinite().all())


def test_robot_without_collisions_stands_on_the_ground_in_its_default_pose(cli, tmp_path):
    _, task = written(cli, tmp_path, DOG.replace("<geom ", '<geom contype="0" conaffinity="0" '))
    assert task["scene"]["entities"]["robot"]["pos"][2] == pytest.approx(0.2205, abs=1e-3)


def test_the_next_command_checks_whether_the_robot_stands(cli, tmp_path):
    result, _ = written(cli, tmp_path, DOG)
    assert " && rlcli lint my-robot && rlcli train my-robot\n" in result.err


def test_the_package_is_described_by_the_task_of_the_robot(cli, tmp_path):
    written(cli, tmp_path, ARM)
    assert (
        'description = "Bring the last body to goals (my-robot)."\n'
        in (tmp_path / "my-robot" / "pyproject.toml").read_text()
    )


def test_velocities_fit_the_size_of_the_robot(cli, tmp_path):
    _, task = written(cli, tmp_path, DOG)
    fast = task["commands"]["velocity"]["lin_vel_x"][1]
    assert fast == pytest.approx((9.81 * 0.2 / 15.0) ** 0.5, rel=0.05)  # the centre of mass is at 0.2 m
    assert task["rewards"]["track_lin_vel"]["std"] == pytest.approx(0.5 * fast, rel=0.01)
    assert task["success"]["velocity"]["at_most"] == pytest.approx(0.42 * fast, rel=0.01)


def test_short_time_step_makes_the_control_period_short(cli, tmp_path):
    _, usual = written(cli, tmp_path, DOG)
    shutil.rmtree(tmp_path / "my-robot")
    _, task = written(cli, tmp_path, DOG.replace("<worldbody>", '<option timestep="0.0001"/><worldbody>'))
    assert (usual["decimation"], usual["episode_length_s"]) == (10, 20.0)
    assert (task["decimation"], task["episode_length_s"]) == (20, 2.0)
    assert task["commands"]["velocity"]["resampling_time_s"] == [1.0, 1.0]
    assert task["commands"]["velocity"]["ang_vel_z"] == [-6.0, 6.0]


def write_assets(folder):
    """Write a mesh in two sizes, an image, a height field and a skin; the meshes have the same file name."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int32)
    for name, size in (("left", 0.1), ("right", 0.2)):
        (folder / name).mkdir(parents=True)
        lines = [*(f"v {x} {y} {z}" for x, y, z in corners * size), *(f"f {a} {b} {c}" for a, b, c in faces + 1)]
        (folder / name / "part.obj").write_text("\n".join(lines))
    Image.new("RGB", (4, 4)).save(folder / "side.png")
    (folder / "field.bin").write_bytes(struct.pack("<2i4f", 2, 2, 0, 1, 2, 3))
    bone = b"arm".ljust(40, b"\0") + struct.pack("<7fi4i4f", 0, 0, 0, 1, 0, 0, 0, 4, 0, 1, 2, 3, 1, 1, 1, 1)
    skin = struct.pack("<4i", 4, 0, 4, 1) + (corners * 0.1).tobytes() + faces.tobytes() + bone
    (folder / "arm.skn").write_bytes(skin)
    (folder / "part.xml").write_text('<mujoco><geom type="mesh" mesh="right" pos="0 0 0.5"/></mujoco>')


ASSETS = """<mujoco><compiler meshdir="files" texturedir="files"/><asset>
<mesh name="left" file="left/part.obj"/><mesh name="right" file="right/part.obj"/>
<hfield name="field" file="field.bin" size="0.2 0.2 0.1 0.1"/><texture name="sides" type="cube" {sides}/>
<material name="painted" texture="sides"/></asset><deformable><skin file="arm.skn"/></deformable><worldbody>
<body name="arm"><joint name="hinge" axis="0 1 0"/><geom type="mesh" mesh="left" material="painted"/>
<geom type="hfield" hfield="field"/><include file="files/part.xml"/></body></worldbody></mujoco>"""


def test_every_file_of_the_model_is_copied(cli, tmp_path):
    write_assets(tmp_path / "files")
    sides = " ".join(f'file{side}="side.png"' for side in ("right", "left", "up", "down", "front", "back"))
    written(cli, tmp_path, ASSETS.format(sides=sides))
    shutil.rmtree(tmp_path / "files")
    copied = tmp_path / "my-robot" / "my_robot"
    names = {"part.obj", "0_part.obj", "side.png", "field.bin", "arm.skn"}
    assert {path.name for path in (copied / "assets").iterdir()} == names
    model = mujoco.MjModel.from_xml_path(str(copied / "model.xml"))
    assert (model.nmesh, model.nhfield, model.nskin, model.ntex) == (2, 1, 1, 1)
    small, large = sorted(float(np.ptp(model.mesh_vert[begin : begin + 4])) for begin in model.mesh_vertadr)
    assert large == pytest.approx(2 * small, rel=1e-3)


def test_robot_that_is_listed_after_an_object_is_the_root(cli, tmp_path):
    ball = '<worldbody><body name="ball" pos="1 0 0.2"><freejoint/><geom size="0.1"/></body>'
    _, task = written(cli, tmp_path, ARM.replace("<worldbody>", ball))
    assert task["commands"]["goal"]["bodies"] == "hand"
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "my-robot" / "my_robot" / "model.xml"))
    assert model.body(1).name == "upper"
    assert model.body("ball").pos.tolist() == [1.0, 0.0, 0.2]


def test_goals_on_a_plane_have_two_columns(cli, tmp_path):
    _, task = written(cli, tmp_path, POINT.format(kind="slide"))
    assert task["observations"]["policy"]["goal"]["columns"] == [0, 1]


def test_robot_whose_last_body_cannot_move_keeps_its_pose(cli, tmp_path):
    result, _ = written(cli, tmp_path, POINT.format(kind="hinge"))
    assert result.json["flavour"] == "balance"


def test_robot_without_keyframe_has_a_warning_and_a_true_readme(cli, tmp_path):
    result, _ = written(cli, tmp_path, ARM)
    readme = (tmp_path / "my-robot" / "README.md").read_text()
    assert "no keyframe: the default pose is zero joint angles" in result.err
    assert "no keyframe, so the default pose is zero joint angles" in readme
    assert "first keyframe" not in readme


def test_robot_with_keyframe_has_no_warning(cli, tmp_path):
    result, _ = written(cli, tmp_path, CART.replace("<worldbody>", '<compiler settotalmass="3"/><worldbody>'))
    assert "warning" not in result.err  # MuJoCo's deprecation of an attribute is none for the user
    assert "is a keyframe of the" in (tmp_path / "my-robot" / "README.md").read_text()


def test_camera_is_as_far_away_as_the_robot_is_large(cli, tmp_path):
    _, task = written(cli, tmp_path, ARM)
    assert task["viewer"]["lookat"] == pytest.approx([0.0, 0.0, 0.35], abs=0.05)  # the arm is 0.73 m high
    distance = np.linalg.norm(np.subtract(task["viewer"]["eye"], task["viewer"]["lookat"]))
    assert 1.0 < distance < 2.0


def test_camera_follows_a_walking_robot(cli, tmp_path):
    _, task = written(cli, tmp_path, DOG)
    assert task["viewer"]["follow"] == "robot"


def test_folder_instead_of_the_robots_file_names_the_files_in_it(cli, tmp_path):
    (tmp_path / "go1").mkdir()
    (tmp_path / "go1" / "scene.xml").write_text(ARM)
    result = cli("new", "my-robot", "--robot", "go1")
    assert result.code == 2
    assert "go1 is a folder" in result.err
    assert "scene.xml" in result.err


@pytest.mark.slow
@pytest.mark.parametrize("text", [DOG, CART, ARM], ids=["dog", "cart", "arm"])
def test_task_passes_check_and_trains(cli, tmp_path, text):
    written(cli, tmp_path, text)
    checked = cli("check", "my-robot/my_robot", "--json")
    assert checked.json["passed"], checked.out
    assert cli("train", "my-robot/my_robot", "--max-iterations", "2", "--num-envs", "32").code == 0


@pytest.mark.parametrize(
    ("text", "code", "message"),
    [
        (None, 2, "--robot: there is no file robot.xml"),
        ("<mujoco>", 4, "robot.xml cannot be used"),
        ("<mujoco><worldbody><geom size='1'/></worldbody></mujoco>", 2, "no joint can be driven"),
        (
            "<mujoco><worldbody><body><joint name='b' type='ball'/><geom size='1'/></body></worldbody></mujoco>",
            4,
            "ball joints are not supported: b",
        ),
    ],
)
def test_file_without_a_usable_robot_is_refused(cli, tmp_path, text, code, message):
    if text is not None:
        (tmp_path / "robot.xml").write_text(text)
    result = cli("new", "my-robot", "--robot", "robot.xml")
    assert (result.code, message in result.err) == (code, True), result.err
    assert not (tmp_path / "my-robot").exists()


def test_meshes_may_lie_anywhere_in_the_package_of_the_robot(cli, tmp_path):
    corners = [(x, y, z) for x in (0, 0.1) for y in (0, 0.1) for z in (0, 0.1)]
    (tmp_path / "zoo" / "parts").mkdir(parents=True)
    (tmp_path / "zoo" / "parts" / "cube.obj").write_text(
        "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "f 1 2 3\nf 1 2 5\nf 1 3 5\nf 2 4 8\nf 3 4 8\nf 5 6 8\n"
    )
    inner = tmp_path / "zoo" / "robots" / "arms" / "one"
    inner.mkdir(parents=True)
    asset = '<compiler meshdir="../../../parts"/><asset><mesh name="cube" file="cube.obj"/></asset><worldbody>'
    robot = inner / "robot.xml"
    robot.write_text(ARM.replace("<worldbody>", asset))
    refused = cli("new", "my-robot", "--robot", robot, "-o", tmp_path / "out")
    assert refused.code == 4
    assert "lies outside of" in refused.err
    (tmp_path / "zoo" / "__init__.py").touch()
    assert cli("new", "my-robot", "--robot", robot, "-o", tmp_path / "out").code == 0
    assert (tmp_path / "out" / "my_robot" / "assets" / "cube.obj").is_file()


def test_joints_are_driven_if_all_actuators_pull_at_tendons(cli, tmp_path):
    begin = ARM.partition("<actuator>")[0]
    tendon = '<tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed></tendon>'
    motor = '<actuator><motor name="pull" tendon="t"/></actuator><sensor><actuatorfrc actuator="pull"/></sensor>'
    _, task = written(cli, tmp_path, begin + tendon + motor + "</mujoco>")
    assert task["actions"]["joint_position"]["joints"] == ["a", "b", "c"]


def test_joints_of_tendons_are_driven_if_they_are_as_many_as_joints_with_an_actuator(cli, tmp_path):
    begin = ARM.partition("<actuator>")[0]
    sensor = '<sensor><actuatorfrc actuator="pull"/></sensor>'
    for pulled, own, kind, driven in (("ab", "c", "reach", ["a", "b", "c"]), ("a", "bc", "balance", ["b", "c"])):
        wrapped = "".join(f'<joint joint="{joint}" coef="1"/>' for joint in pulled)
        motors = "".join(f'<motor joint="{joint}"/>' for joint in own) + '<motor name="pull" tendon="t"/>'
        rest = f'<tendon><fixed name="t">{wrapped}</fixed></tendon><actuator>{motors}</actuator>{sensor}</mujoco>'
        _, task = written(cli, tmp_path, begin + rest)
        assert task["summary"].startswith({"reach": "Bring", "balance": "Keep"}[kind])
        (action,) = task["actions"].values()
        assert action["joints"] == driven
        assert cli("validate", "--deep", "my-robot/my_robot").code == 0
        shutil.rmtree(tmp_path / "my-robot")


def test_servos_with_dynamics_are_replaced(cli, tmp_path):
    filtered = 'dyntype="filter" dynprm="0.1" gainprm="50" biastype="affine" biasprm="0 -50"'
    text = ARM.replace('<position joint="a" kp="20" forcerange="-9 9"/>', f'<general joint="a" {filtered}/>')
    _, task = written(cli, tmp_path, text)
    assert task["actions"]["joint_position"]["joints"] == ["a", "b", "c"]
    assert task["scene"]["entities"]["robot"]["joints"].keys() == {"a", "b", "c"}
    assert cli("validate", "--deep", "my-robot/my_robot").code == 0

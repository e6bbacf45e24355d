"""`rlcli new --robot`: what a task for the robot of an MJCF contains, and refused files."""

import pytest
import yaml

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
ARM = """<mujoco><worldbody><body name="upper"><joint name="a" axis="0 1 0" range="-90 90"/>
<geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.4" mass="0.5"/><body name="lower" pos="0 0 0.4">
<joint name="b" axis="1 0 0" range="-90 90"/><geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.3" mass="0.3"/>
<body name="hand" pos="0 0 0.3"><joint name="c" axis="0 1 0" range="-90 90"/><geom size="0.03" mass="0.1"/></body>
</body></body></worldbody><actuator><position joint="a" kp="20" forcerange="-9 9"/><motor joint="b" gear="5"
ctrlrange="-1 1" ctrllimited="true"/><motor joint="c" gear="2" ctrlrange="-1 1" ctrllimited="true"/></actuator></mujoco>
"""
WHEEL = """<mujoco><worldbody><body name="body" pos="0 0 0.3"><freejoint/><geom size="0.1" mass="1"/>
<body name="wheel" pos="0 0 -0.2"><joint name="axle" axis="0 1 0"/><geom size="0.1" mass="0.2"/></body></body>
</worldbody><actuator><motor joint="axle" gear="2"/></actuator></mujoco>"""


def written(cli, tmp_path, text):
    (tmp_path / "robot.xml").write_text(text)
    result = cli("new", "my-robot", "--robot", "robot.xml", "--json")
    assert result.code == 0, result.err
    assert cli("validate", "my-robot/my_robot").code == 0
    return result, yaml.safe_load((tmp_path / "my-robot" / "my_robot" / "task.yaml").read_text())


def test_floating_base_tracks_velocities(cli, tmp_path):
    result, task = written(cli, tmp_path, DOG)
    assert result.json["flavour"] == "velocity"
    assert "5 joints: root, (unnamed)" in result.err
    robot = task["scene"]["entities"]["robot"]
    assert robot["pos"][2] == pytest.approx(0.225, abs=0.001)  # the legs just touch the ground
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
    assert task["success"]["joints"]["joints"] == ["hinge"]


def test_floating_base_without_legs_balances(cli, tmp_path):
    _, task = written(cli, tmp_path, WHEEL)
    assert task["success"] == {"tilt": {"func": "root_tilt", "at_most": 0.5}}


def test_fixed_base_reaches_with_its_last_body(cli, tmp_path):
    _, task = written(cli, tmp_path, ARM)
    goal = task["commands"]["goal"]
    assert goal["bodies"] == "hand"
    assert 0.5 < goal["z"][0] < goal["z"][1] <= 0.7
    # gains of the motors follow from their efforts; the position actuator keeps its own
    joints = task["scene"]["entities"]["robot"]["joints"]
    assert {name: values["effort_limit"] for name, values in joints.items()} == {"b": 5.0, "c": 2.0}


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
        (None, 2, "there is no file robot.xml"),
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

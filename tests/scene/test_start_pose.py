"""Start pose of an entity: `pos` and `quat` are the pose of its root, whatever pose the root has in the MJCF."""

import mujoco
import numpy as np
import pytest
from support.worlds import PENDULUM_TASK, build, edited, write

BODY = '<body name="base" {pose}>{joint}<geom size="0.1" mass="1"/><body name="tip" pos="0.3 0 0">\
<joint name="hinge" axis="0 1 0"/><geom size="0.05" mass="0.2"/></body></body>'
TURNED = {
    "as a quaternion": 'quat="0.6 0 0.8 0"',
    "as Euler angles": 'euler="10 20 30"',
    "as an axis and an angle": 'axisangle="0 1 1 0.4"',
}


def model_of(folder, body, **entity):
    xml = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    scene = {"ground": None, "entities": {"robot": {"model": "robot.xml", **entity}}}
    actions = {"torque": {"func": "joint_effort", "joints": ["hinge"]}}
    task = edited(PENDULUM_TASK, scene=scene, actions=actions)
    return build(write(folder / "robot", task, robot_xml=xml))


def pose_of_root(env):
    state = env.entities["robot"].data.default_root_state[0].numpy()
    model = env.engine.model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    body = model.body("robot/base").id
    np.testing.assert_allclose(data.xpos[body], state[:3], atol=1e-6)
    assert abs(data.xquat[body] @ state[3:7]) == pytest.approx(1.0, abs=1e-6)
    return data.xpos[body], data.xquat[body]


@pytest.mark.parametrize("joint", ["<freejoint/>", ""], ids=["floating", "fixed"])
@pytest.mark.parametrize("height", [0.0, 0.4, 0.62])
def test_pos_is_position_of_root(tmp_path, height, joint):
    body = BODY.format(pose=f'pos="0.1 0 {height}"', joint=joint)
    env = model_of(tmp_path, body, pos=[0.0, 0.5, 0.4])
    np.testing.assert_allclose(pose_of_root(env)[0], [0.0, 0.5, 0.4], atol=1e-12)
    body_pos = env.entities["robot"].data.root_pos_w[0]
    assert body_pos.tolist() == pytest.approx([0.0, 0.5, 0.4])
    kept = model_of(tmp_path, body)
    assert pose_of_root(kept)[0].tolist() == [0.1, 0.0, height]


@pytest.mark.parametrize("joint", ["<freejoint/>", ""], ids=["floating", "fixed"])
@pytest.mark.parametrize("turn", TURNED)
@pytest.mark.parametrize("frames", ["", '<frame pos="0 1 0" euler="0 0 90">'])
def test_pos_and_quat_replace_one_by_one(tmp_path, turn, frames, joint):
    body = BODY.format(pose=f'pos="0 0 0.62" {TURNED[turn]}', joint=joint)
    body = frames + body + ("</frame>" if frames else "")
    pos, quat = pose_of_root(model_of(tmp_path, body))
    wanted = np.array([0.0, 0.6, 0.0, -0.8])
    moved_pos, same_quat = pose_of_root(model_of(tmp_path, body, pos=[1.0, 2.0, 3.0]))
    np.testing.assert_allclose(moved_pos, [1.0, 2.0, 3.0], atol=1e-12)
    assert abs(same_quat @ quat) == pytest.approx(1.0)
    same_pos, turned = pose_of_root(model_of(tmp_path, body, quat=(2 * wanted).tolist()))
    np.testing.assert_allclose(same_pos, pos, atol=1e-12)
    assert abs(turned @ wanted) == pytest.approx(1.0)
    both = pose_of_root(model_of(tmp_path, body, pos=[1.0, 2.0, 3.0], quat=wanted.tolist()))
    np.testing.assert_allclose(both[0], [1.0, 2.0, 3.0], atol=1e-12)
    assert abs(both[1] @ wanted) == pytest.approx(1.0)


def test_rest_of_the_mjcf_moves_with_the_root(tmp_path):
    body = '<geom name="plate" type="box" size="1 1 0.1"/>' + BODY.format(pose='pos="0 0 0.62"', joint="")
    body += '<body name="other" pos="0 3 0"><geom size="0.1"/></body>'
    model = model_of(tmp_path, body, pos=[0.0, 0.0, 1.0]).engine.model
    assert model.geom("robot/plate").pos.tolist() == pytest.approx([0.0, 0.0, 0.38])
    assert model.body("robot/other").pos.tolist() == pytest.approx([0.0, 3.0, 0.38])

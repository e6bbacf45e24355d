"""The tasks `reach` and `reach-ik`, and the arm: joints, motors, commands, success."""

import math

import mujoco
import numpy as np
import pytest
import torch
from support.worlds import actions, build

from rlcli.sim.rotations import turn_between

torch.set_num_threads(1)

READY = (0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4)
"""The default pose: the hand points straight down, its x axis forwards."""
ARM = slice(0, 7)


@pytest.fixture(scope="module")
def env():
    return build("reach", 4)


@pytest.fixture
def arm(env):
    """Return the compiled arm and its data."""
    return env.world()


def body(model, name):
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, f"robot/{name}")


def pose(model, data, joints):
    """Return position and axes (columns) of the hand for some joints."""
    data.qpos[ARM] = joints
    mujoco.mj_forward(model, data)
    hand = body(model, "hand")
    return data.xpos[hand].copy(), data.xmat[hand].reshape(3, 3).copy()


def put(env, joints):
    """Set all arms to one pose, at rest."""
    env.engine.field("qpos")[:, ARM] = torch.tensor(joints, dtype=torch.float64)
    env.engine.field("qvel")[:] = 0.0
    env.engine.forward(env._select_all())
    env.sim.refresh()


def pay(env):
    """Return the value of each reward term in environment 0."""
    env.reward_manager.compute(torch.zeros(env.num_envs, dtype=torch.bool))
    return {name: float(value[0]) for name, value in env.reward_manager.values().items()}


# --- the arm ---


def test_height_of_stretched_arm(arm):
    """0.333 + 0.316 + 0.384 m to the wrist; from there 0.088 m ahead and the flange's 0.107 m back down."""
    place, axes = pose(*arm, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert place == pytest.approx([0.088, 0.0, 0.333 + 0.316 + 0.384 - 0.107], abs=1e-6)
    assert axes[:, 2] == pytest.approx([0.0, 0.0, -1.0], abs=1e-6)


def test_default_pose_of_hand(arm):
    place, axes = pose(*arm, READY)
    # leaning back by 45 degrees, the elbow's 0.0825 m square to the upper arm; then ahead, 0.0825 m above that
    half = math.sqrt(0.5)
    ahead = (0.0825 - 0.316) * half + 0.384 + 0.088
    height = 0.333 + (0.316 + 0.0825) * half + 0.0825 - 0.107
    assert place == pytest.approx([ahead, 0.0, height], abs=1e-5)
    assert axes == pytest.approx(np.diag([1.0, -1.0, -1.0]), abs=1e-5)


def test_joint_limits_and_torques_equal_panda(arm):
    model, _ = arm
    low, high = model.jnt_range[ARM].T
    assert low.tolist() == [-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973]
    assert high.tolist() == [2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973]
    assert model.jnt_range[7:9].tolist() == [[0.0, 0.04]] * 2
    assert model.actuator_forcerange[:7, 1].tolist() == [87.0] * 4 + [12.0] * 3
    weights = [4.970684, 0.646926, 3.228604, 3.587895, 1.225946, 1.666555, 0.735522, 0.73, 0.015, 0.015]
    names = [*(f"link{i}" for i in range(1, 8)), "hand", "finger_left", "finger_right"]
    assert [float(model.body_mass[body(model, name)]) for name in names] == pytest.approx(weights)


@pytest.mark.parametrize(("joint", "fastest"), [(0, 2.175), (6, 12.0 / 4.6)])
def test_joint_speed_is_limited_by_damping(arm, joint, fastest):
    """Full torque against the joint's damping: 2.175 rad/s of the first four joints, 2.61 rad/s of the last three."""
    model, data = arm
    data.qpos[ARM], data.ctrl[ARM] = READY, READY
    data.qpos[joint], data.ctrl[joint] = -2.8, 2.8
    speeds = []
    for _ in range(60):
        mujoco.mj_step(model, data)
        speeds.append(float(data.qvel[joint]))
    assert 0.95 * fastest < max(speeds) < 1.02 * fastest


def test_gravity_is_compensated(arm):
    model, data = arm
    data.qpos[ARM], data.ctrl[ARM] = READY, READY
    for _ in range(120):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos[ARM] - READY).max() < 1e-4


def test_gripper_collides_with_ground_only(arm):
    model, data = arm
    pose(model, data, [0.0, 1.2, 0.0, -1.6, 0.0, 2.8, 0.785])
    bodies = {model.geom(int(g)).name for pair in data.contact.geom for g in pair}
    assert bodies
    assert bodies <= {"robot/finger_left", "robot/finger_right", "robot/hand", "ground", "terrain", "floor"}
    folded = [0.0, 0.0, 0.0, -3.0, 0.0, 0.0, 0.0]
    pose(model, data, folded)
    assert data.ncon == 0


# --- commands ---


@pytest.mark.parametrize("task", ["reach", "reach-ik"])
def test_commands_are_in_range(task):
    env = build(task, 256)
    env.reset()
    command = env.command_manager.get_term("ee_pose").command
    for column, (low, high) in enumerate([(0.35, 0.65), (-0.2, 0.2), (0.15, 0.5)]):
        values = command[:, column]
        assert low <= float(values.min()) < low + 0.03
        assert high - 0.03 < float(values.max()) <= high
    _, x, y, _ = command[:, 3:].unbind(1)
    down = 1.0 - 2.0 * (x * x + y * y)
    torch.testing.assert_close(down, torch.full_like(down, -1.0))


def test_command_lasts_four_seconds(env):
    env.reset()
    command = env.command_manager.get_term("ee_pose").command
    before, changes = command.clone(), []
    for step in range(1, 359):
        env.step(torch.zeros(4, 7))
        if not torch.equal(before, command):
            changes.append(step)
            before.copy_(command)
    assert changes == [120, 240]


def test_success_requires_position_and_orientation(env):
    """Asked for exactly where the hand is, then 6 cm beside it, then turned by 0.25 rad."""
    env.reset()
    put(env, READY)
    term = env.command_manager.get_term("ee_pose")
    place, attitude = term.body_pose_w
    term.command[:, :3] = place - env.entities["robot"].data.root_pos_w
    term.command[:, 3:] = attitude
    term.command[1, 0] += 0.06
    turned = torch.tensor([math.cos(0.125), 0.0, 0.0, math.sin(0.125)])
    w, x, y, z = attitude[2].unbind()
    c, s = turned[0], turned[3]
    term.command[2, 3:] = torch.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])
    assert float(turn_between(term.command[2:3, 3:], attitude[2:3])) == pytest.approx(0.25, abs=1e-4)
    assert env.compute_success().tolist() == [True, False, False, True]


def test_rewards_of_distance_and_angle(env):
    env.reset()
    put(env, READY)
    term = env.command_manager.get_term("ee_pose")
    place, attitude = term.body_pose_w
    term.command[:, :3] = place - env.entities["robot"].data.root_pos_w
    term.command[:, 2] += 0.1
    term.command[:, 3:] = attitude
    paid = pay(env)
    assert paid["position"] == pytest.approx(-0.2 * 0.1 / 30, rel=1e-3)
    assert paid["position_fine"] == pytest.approx(0.1 * (1.0 - math.tanh(1.0)) / 30, rel=1e-3)
    assert paid["orientation"] == pytest.approx(0.0, abs=1e-5)
    half = math.sqrt(0.5)
    term.command[:, 3:] = torch.tensor([0.0, half, half, 0.0])  # a quarter of a turn about the vertical
    assert pay(env)["orientation"] == pytest.approx(-0.1 * math.pi / 2 / 30, rel=1e-3)


def test_penalties_grow_after_4500_steps(env):
    env.reset()
    put(env, READY)
    env.engine.field("qvel")[:, 0] = 1.0
    env.sim.refresh()
    for step, weight in [(0, -1e-4), (4499, -1e-4), (4500, -1e-3)]:
        env.curriculum_manager.advance(torch.tensor(step))
        assert pay(env)["joint_vel"] == pytest.approx(weight / 30, rel=1e-3), step
    weights = [f"Curriculum/{name}" for name in ("action_rate", "joint_vel")]
    assert [env.extras()[name] for name in weights] == pytest.approx([-5e-3, -1e-3])
    env.curriculum_manager.advance(torch.tensor(0))


def test_initial_joints_are_scaled_default_pose():
    env = build("reach", 256)
    env.reset()
    joints, home = env.entities["robot"].data.joint_pos[:, ARM], torch.tensor(READY)
    low, high = env.entities["robot"].data.joint_pos_limits[ARM].unbind(1)
    ends = torch.stack([0.5 * home, 1.5 * home])
    assert bool((joints >= torch.maximum(ends.amin(0), low) - 1e-5).all())
    assert bool((joints <= torch.minimum(ends.amax(0), high) + 1e-5).all())
    assert float((joints.amax(0) - joints.amin(0))[1]) > 0.5


# --- actions ---


def test_action_moves_joints_by_half_radian(env):
    env.reset()
    action = torch.zeros(4, 7)
    action[:, 0], action[:, 6] = 0.5, -1.0
    for _ in range(60):
        env.step(action)
    reached = env.entities["robot"].data.joint_pos[:, ARM]
    wanted = torch.tensor(READY) + 0.5 * action
    torch.testing.assert_close(reached, wanted, atol=0.01, rtol=0)


def test_inverse_kinematics_follows_commanded_axis():
    env = build("reach-ik", 2)
    env.reset()
    put(env, READY)
    env.step(torch.zeros(2, 6))
    place, attitude = (value.clone() for value in env.command_manager.get_term("ee_pose").body_pose_w)
    action = torch.zeros(2, 6)
    action[0, 2], action[1, 5] = -0.05, 0.25  # down; about the vertical
    for _ in range(30):
        env.step(action)
    moved, turned = env.command_manager.get_term("ee_pose").body_pose_w
    x, y, z = (moved - place)[0].tolist()
    assert z < -0.05
    assert max(abs(x), abs(y)) < 0.3 * abs(z)
    assert float(turn_between(attitude, turned)[0]) < 0.2, "joints of unequal motors lag unequally"
    assert float(turn_between(turned, attitude)[1]) > 0.3
    assert float((moved - place)[1].abs().max()) < 0.01


@pytest.mark.parametrize("task", ["reach", "reach-ik"])
def test_random_actions_keep_simulation_stable(task):
    env = build(task, 16)
    env.reset()
    fastest = 0.0
    for action in actions(200, 16, env.layout.action_size):
        env.step(6.0 * action.sign())
        fastest = max(fastest, float(env.entities["robot"].data.joint_vel[:, ARM].abs().max()))
    assert env.divergences == 0
    assert 2.0 < fastest < 10.0, "a joint's own motor gives 2.6 rad/s; what others do to it comes on top"

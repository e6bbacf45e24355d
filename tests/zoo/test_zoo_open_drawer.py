"""The task `open-drawer`: observations, rewards, targets; the drawer can be pulled open."""

import math

import mujoco
import numpy as np
import pytest
import torch
from support.worlds import actions, build

from rlcli_tasks.open_drawer.task import JOINTS

torch.set_num_threads(1)

HOME = (1.157, -1.066, -0.155, -2.239, -1.841, 1.003, 0.469)
ARM, FINGERS, DRAWER = slice(0, 7), slice(7, 9), 9
"""Columns of qpos."""
AT_HANDLE = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""The hand's axes (columns) when it points at the cabinet, one finger above the other."""


@pytest.fixture(scope="module")
def env():
    env = build("open-drawer", 4)
    env.reset()
    return env


def reach_for(model, data, point, start):
    """Return joints that bring the gripper to a point, oriented for the handle."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "robot/grasp")
    hand = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "robot/hand")
    trial, wanted = mujoco.MjData(model), np.zeros(4)
    trial.qpos[:] = data.qpos
    trial.qpos[ARM] = start
    mujoco.mju_mat2Quat(wanted, AT_HANDLE.flatten())
    low, high = model.jnt_range[ARM].T
    for _ in range(200):
        mujoco.mj_fwdPosition(model, trial)
        error, back, left = np.zeros(6), np.zeros(4), np.zeros(4)
        error[:3] = point - trial.site_xpos[site]
        mujoco.mju_negQuat(back, trial.xquat[hand])
        mujoco.mju_mulQuat(left, wanted, back)
        mujoco.mju_quat2Vel(error[3:], left, 1.0)
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, trial, linear, angular, site)
        jacobian = np.vstack([linear, angular])[:, ARM]
        step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 0.01 * np.eye(6), error.clip(-0.2, 0.2))
        trial.qpos[ARM] = (trial.qpos[ARM] + step).clip(low, high)
    return trial.qpos[ARM].copy()


def put(env, joints=HOME, fingers=(0.035, 0.035), drawer=0.0, row=0):
    """Set the state of one environment, at rest."""
    qpos = env.engine.field("qpos")
    qpos[row, ARM], qpos[row, FINGERS] = torch.tensor(joints).double(), torch.tensor(fingers).double()
    qpos[row, DRAWER] = drawer
    env.engine.field("qvel")[row] = 0.0
    env.engine.forward(env._select_all())
    env.sim.refresh()


def pay(env, row=0, action=None):
    """Return the reward of the current state."""
    env.task.actions[row] = 0.0 if action is None else torch.tensor(action)
    env.task.get_observations()
    env.task.calculate_metrics()
    return float(env.task.rew_buf[row])


def at_handle(env):
    """Return joints with the gripper around the handle of the closed drawer."""
    model, data = env.world()
    return reach_for(model, data, np.array([0.35, 0.0, 0.72]), HOME)


# --- the task can be done ---


def test_closed_gripper_pulls_drawer_open(env):
    model, data = env.world()
    data.qpos[ARM], data.qpos[FINGERS] = at_handle(env), 0.04
    data.ctrl[ARM], data.ctrl[FINGERS] = data.qpos[ARM], 0.0
    for _ in range(120):
        mujoco.mj_step(model, data)
    assert data.qpos[FINGERS].tolist() == pytest.approx([0.01] * 2, abs=2e-3), "they hold the bar"
    joints = data.qpos[ARM].copy()
    for pull in np.linspace(0.02, 0.4, 20):
        joints = reach_for(model, data, np.array([0.35 + pull, 0.0, 0.72]), joints)
        data.ctrl[ARM] = joints
        for _ in range(36):
            mujoco.mj_step(model, data)
    assert data.qpos[DRAWER] > 0.39


def test_released_drawer_closes(env):
    """The spring of 10 N/m pulls 2.8 kg: a quarter of a period is pi / 2 sqrt(m / k) = 0.83 s, damping apart."""
    model, data = env.world()
    data.qpos[ARM] = data.ctrl[ARM] = HOME
    data.qpos[DRAWER] = 0.2
    seconds = 0.0
    while data.qpos[DRAWER] > 0.0 and seconds < 3.0:
        mujoco.mj_step(model, data)
        seconds += model.opt.timestep
    assert 0.8 < seconds < 1.1


# --- observations ---


def test_observation_of_state(env):
    put(env, drawer=0.12)
    env.engine.field("qvel")[0, :10] = torch.arange(10).double() / 10
    env.sim.refresh()
    env.task.get_observations()
    seen = dict(zip(env.task.observation_names, env.task.obs_buf[0].tolist(), strict=True))
    low, high = env.entities["robot"].data.joint_pos_limits.unbind(1)
    for column, (name, value) in enumerate(zip(JOINTS, (*HOME, 0.035, 0.035), strict=True)):
        scaled = 2.0 * (value - float(low[column])) / float(high[column] - low[column]) - 1.0
        assert seen[f"{name}_pos"] == pytest.approx(scaled, abs=1e-5)
        assert seen[f"{name}_vel"] == pytest.approx(0.01 * column, abs=1e-6)
    assert seen["drawer_pos"] == pytest.approx(0.12)
    assert seen["drawer_vel"] == pytest.approx(0.9)
    grasp = env.entities["robot"].data.site_pos_w[0, 0]
    way = torch.tensor([0.35 + 0.12, 0.0, 0.72]) - grasp
    assert [seen[f"to_handle_{axis}"] for axis in "xyz"] == pytest.approx(way.tolist(), abs=1e-5)


# --- rewards ---


def test_gripper_at_handle_has_full_reward(env):
    put(env, at_handle(env).tolist(), (0.03, 0.02))
    aligned, near, around = 1.0, 2.0, 0.5
    fingers = (0.04 - 0.03) + (0.04 - 0.02)
    expected = 2.0 * near + 0.5 * aligned + 10.0 * around + 100.0 * fingers + 10.0 * fingers
    assert pay(env) == pytest.approx(expected, abs=0.02)


def test_held_open_drawer_has_bonus(env):
    model, data = env.world()
    for opening, bonus in [(0.005, 0.0), (0.1, 0.5), (0.25, 1.0), (0.395, 2.0)]:
        joints = reach_for(model, data, np.array([0.35 + opening, 0.0, 0.72]), at_handle(env))
        put(env, joints.tolist(), (0.04, 0.04), opening)
        expected = 4.0 + 0.5 + 5.0 + 30.0 * 1.5 * opening + bonus
        assert pay(env) == pytest.approx(expected, abs=0.03), opening


def test_reward_far_from_handle(env):
    put(env, drawer=0.3)
    robot = env.entities["robot"].data
    distance = math.dist(robot.site_pos_w[0, 0].tolist(), [0.65, 0.0, 0.72])
    hand = mujoco.mj_name2id(env.engine.model, mujoco.mjtObj.mjOBJ_BODY, "robot/hand")
    axes = torch.as_tensor(env.engine.field("xmat")[0, hand]).reshape(3, 3)
    ahead, up = -float(axes[0, 2]), float(axes[2, 1])
    assert ahead > 0.3
    assert up > 0.9
    below_and_above = float(robot.body_pos_w[0, -1, 2]) < 0.72 < float(robot.body_pos_w[0, -2, 2])
    assert not below_and_above
    near = (1.0 / (1.0 + distance**2)) ** 2
    expected = 2.0 * near + 0.5 * 0.5 * (ahead * abs(ahead) + up * abs(up)) + 30.0 * 0.3 + 0.5
    assert pay(env) == pytest.approx(expected, abs=1e-3)
    assert pay(env, action=[1.0] * 9) == pytest.approx(expected - 0.09, abs=1e-3)


# --- actions, starts, ends ---


def test_actions_move_targets_within_limits(env):
    env.reset()
    before = env.task.targets.clone()
    action = torch.zeros(4, 9)
    action[:, 0], action[:, 6], action[:, 7] = 0.2, -0.2, -1.0
    env.step(action)
    moved = (env.task.targets - before)[0].tolist()
    assert moved[0] == pytest.approx(0.2 * 2.5 / 60, abs=1e-5)
    assert moved[6] == pytest.approx(-0.2 * 2.5 / 60, abs=1e-5)
    assert moved[7] == pytest.approx(max(-0.25 / 60, -float(before[0, 7])), abs=1e-5)
    for _ in range(200):
        env.step(torch.ones(4, 9))
    high = env.entities["robot"].data.joint_pos_limits[:, 1]
    torch.testing.assert_close(env.task.targets, high.expand(4, 9))
    torch.testing.assert_close(env.engine.field("ctrl")[:, :9].float(), high.expand(4, 9))


def test_initial_states_fill_ranges():
    env = build("open-drawer", 256)
    env.reset()
    joints, default = env.entities["robot"].data.joint_pos, torch.tensor([*HOME, 0.035, 0.035])
    low, high = env.entities["robot"].data.joint_pos_limits.unbind(1)
    assert bool((joints >= torch.maximum(default - 0.125, low) - 1e-6).all())
    assert bool((joints <= torch.minimum(default + 0.125, high) + 1e-6).all())
    assert float((joints[:, ARM].amax(0) - joints[:, ARM].amin(0)).min()) > 0.24
    torch.testing.assert_close(env.task.targets, joints)
    drawer = env.engine.field("qpos")[:, DRAWER]
    assert 0.0 <= float(drawer.min()) < 0.001
    assert 0.009 < float(drawer.max()) <= 0.01


def test_open_drawer_succeeds_without_termination(env):
    env.reset()
    put(env, drawer=0.36, row=0)
    put(env, drawer=0.34, row=1)
    assert env.compute_success().tolist() == [True, False, False, False]
    put(env, drawer=0.4, row=0)
    result = env.step(torch.zeros(4, 9))
    assert not bool(result.terminated.any() | result.truncated.any())


def test_random_actions_keep_simulation_stable():
    env = build("open-drawer", 16)
    env.reset()
    for action in actions(200, 16, 9):
        env.step(action.sign())
    assert env.divergences == 0
    assert float(env.engine.field("qvel").abs().max()) < 100.0

"""The task `lift-cube`: grasp, rewards, initial states, terminations."""

import math

import mujoco
import numpy as np
import pytest
import torch
from support.worlds import actions, build

torch.set_num_threads(1)

ARM, FINGERS, CUBE = slice(0, 7), slice(7, 9), slice(9, 16)
"""Columns of qpos."""


@pytest.fixture(scope="module")
def env():
    return build("lift-cube", 4)


def set_cube(env, cube, row=None):
    """Set the cube in one environment, or in all."""
    rows = slice(None) if row is None else row
    env.engine.field("qpos")[rows, 9:12] = torch.tensor(cube, dtype=torch.float64)
    env.engine.field("qvel")[:] = 0.0
    env.engine.forward(env._select_all())
    env.sim.refresh()


def reward_terms(env):
    """Return the value of each reward term in the current state. (num_envs,) each"""
    env.reward_manager.compute(torch.zeros(env.num_envs, dtype=torch.bool))
    return {name: value.clone() for name, value in env.reward_manager.values().items()}


def reach_for(model, data, point):
    """Return joints that bring the gripper to a point with the hand pointing down."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "robot/grasp")
    hand = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "robot/hand")
    trial = mujoco.MjData(model)
    trial.qpos[:] = data.qpos
    low, high = model.jnt_range[ARM].T
    for _ in range(200):
        mujoco.mj_fwdPosition(model, trial)
        error, back, left = np.zeros(6), np.zeros(4), np.zeros(4)
        error[:3] = point - trial.site_xpos[site]
        mujoco.mju_negQuat(back, trial.xquat[hand])
        mujoco.mju_mulQuat(left, np.array([0.0, 1.0, 0.0, 0.0]), back)
        mujoco.mju_quat2Vel(error[3:], left, 1.0)
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, trial, linear, angular, site)
        jacobian = np.vstack([linear, angular])[:, ARM]
        step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 0.01 * np.eye(6), error.clip(-0.2, 0.2))
        trial.qpos[ARM] = (trial.qpos[ARM] + step).clip(low, high)
    return trial.qpos[ARM].copy()


def move(model, data, joints, grip, seconds):
    """Move the targets to `joints` in a straight line."""
    begin, steps = data.ctrl[ARM].copy(), round(seconds / model.opt.timestep)
    for step in range(steps):
        data.ctrl[ARM] = begin + (joints - begin) * min(1.0, (step + 1) / (0.6 * steps))
        data.ctrl[FINGERS] = grip
        mujoco.mj_step(model, data)


# --- the grasp ---


def test_closed_gripper_lifts_cube_without_slip(env):
    model, data = env.world()
    cube = np.array([0.5, 0.0, 0.024])
    data.qpos[CUBE] = [*cube, 1.0, 0.0, 0.0, 0.0]
    data.qpos[ARM], data.qpos[FINGERS] = (0.0, -0.3, 0.0, -2.4, 0.0, 2.1, 0.785), 0.04
    above = reach_for(model, data, cube + np.array([0.0, 0.0, 0.12]))
    data.qpos[ARM] = data.ctrl[ARM] = above
    grasp = reach_for(model, data, cube)
    move(model, data, grasp, 0.04, 1.5)
    assert np.abs(data.qpos[9:11] - cube[:2]).max() < 1e-3, "open fingers pass by the cube"
    move(model, data, grasp, 0.0, 0.5)
    assert data.qpos[FINGERS].tolist() == pytest.approx([0.024] * 2, abs=2e-3)
    move(model, data, reach_for(model, data, np.array([0.45, 0.15, 0.4])), 0.0, 1.5)
    held = data.qpos[9:12].copy()
    assert held == pytest.approx([0.45, 0.15, 0.4], abs=0.01)
    move(model, data, data.ctrl[ARM].copy(), 0.0, 3.0)
    assert np.abs(data.qpos[9:12] - held).max() < 1e-3
    move(model, data, data.ctrl[ARM].copy(), 0.04, 0.6)
    assert float(data.qpos[11]) < 0.1, "and an open one drops it"


def test_cube_on_table_stays(env):
    model, data = env.world()
    data.qpos[ARM] = data.ctrl[ARM] = (0.0, -0.569, 0.0, -2.81, 0.0, 3.037, 0.741)
    data.qpos[CUBE] = [0.5, 0.1, 0.024, 1.0, 0.0, 0.0, 0.0]
    for _ in range(400):
        mujoco.mj_step(model, data)
    assert data.qpos[9:12] == pytest.approx([0.5, 0.1, 0.024], abs=5e-4)


# --- rewards ---


def test_only_a_held_cube_is_rewarded(env):
    env.reset()
    grasp = env.entities["robot"].data.site_pos_w[0, 0].double()
    for off, lifted in ((0.0, 1.0), (0.029, 1.0), (0.031, 0.0)):
        set_cube(env, (grasp + torch.tensor([0.0, off, 0.0])).tolist())
        paid = reward_terms(env)
        assert paid["lifting"].tolist() == pytest.approx([15.0 * 0.02 * lifted] * 4), off
        assert (paid["goal"] > 0).tolist() == [bool(lifted)] * 4, off


def test_goal_distance_reward(env):
    env.reset()
    grasp = env.entities["robot"].data.site_pos_w[0, 0].double()
    set_cube(env, grasp.tolist())
    command = env.command_manager.get_term("object_pose").command
    for row, off in enumerate((0.0, 0.03, 0.1, 0.3)):
        command[row, :3] = grasp + torch.tensor([0.0, 0.0, off])
    paid = reward_terms(env)
    wide = [16.0 * 0.02 * (1.0 - math.tanh(off / 0.3)) for off in (0.0, 0.03, 0.1, 0.3)]
    fine = [5.0 * 0.02 * (1.0 - math.tanh(off / 0.05)) for off in (0.0, 0.03, 0.1, 0.3)]
    assert paid["goal"].tolist() == pytest.approx(wide, abs=1e-5)
    assert paid["goal_fine"].tolist() == pytest.approx(fine, abs=1e-5)
    assert env.compute_success().tolist() == [True, True, False, False]


def test_reaching_reward(env):
    env.reset()
    grasp = env.entities["robot"].data.site_pos_w[0, 0].double()
    set_cube(env, (grasp + torch.tensor([0.0, 0.1, 0.0])).tolist())
    assert float(reward_terms(env)["reaching"][0]) == pytest.approx(0.02 * (1.0 - math.tanh(1.0)), rel=1e-3)


# --- initial states and terminations ---


def test_initial_cubes_are_spread_over_table():
    env = build("lift-cube", 256)
    env.reset()
    at = env.entities["object"].data.root_pos_w
    for column, (low, high) in enumerate([(0.4, 0.6), (-0.25, 0.25)]):
        assert low <= float(at[:, column].min()) < low + 0.02
        assert high - 0.02 < float(at[:, column].max()) <= high
    goal = env.command_manager.get_term("object_pose").command[:, :3]
    for column, (low, high) in enumerate([(0.4, 0.6), (-0.25, 0.25), (0.25, 0.5)]):
        assert low <= float(goal[:, column].min())
        assert float(goal[:, column].max()) <= high


def test_cube_off_table_terminates(env):
    env.reset()
    set_cube(env, [0.5, 0.75, 0.024], 1)
    set_cube(env, [1.1, 0.0, 0.024], 2)
    result = env.step(torch.zeros(4, 8))
    assert result.terminated.tolist() == [False, True, True, False]


def test_last_action_controls_gripper(env):
    env.reset()
    action = torch.zeros(4, 8)
    action[:2, 7], action[2:, 7] = -0.1, 0.1
    for _ in range(50):
        env.step(action)
    fingers = env.entities["robot"].data.joint_pos[:, FINGERS]
    assert float(fingers[:2].max()) < 0.005
    assert float(fingers[2:].min()) > 0.035


def test_random_actions_keep_simulation_stable():
    env = build("lift-cube", 16)
    env.reset()
    for action in actions(150, 16, 8):
        env.step(4.0 * action.sign())
    assert env.divergences == 0
    assert float(env.engine.field("qvel").abs().max()) < 100.0

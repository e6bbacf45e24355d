"""The task `ant-direct`: model, observations, rewards, terminations, initial states."""

import json
import math
import subprocess
import sys
from itertools import pairwise

import mujoco
import pytest
import torch
from support.direct_states import (
    HOST_OPERATIONS,
    OperationRecorder,
    observe,
    quat_around,
    reward_and_done,
    set_floating_state,
)
from support.worlds import build

from rlcli_tasks.ant.task import JOINTS

LEGS = slice(7, 15)
"""Columns of the legs in qpos; in qvel they are columns 6 to 13."""
REST = torch.tensor([0.0, math.pi / 4] * 4, dtype=torch.float64)


@pytest.fixture
def env():
    env = build("ant-direct", 4)
    env.reset()
    return env


def put(env, row=0, position=(0.0, 0.0, 0.5), quat=(1.0, 0.0, 0.0, 0.0), linear=(0, 0, 0), angular=(0, 0, 0),
        joints=REST, rates=0.0):  # fmt: skip
    """Set the state of one environment; angular velocity is in the torso's frame."""
    set_floating_state(env, row, position, quat, linear, angular, joints, rates)


# --- the model ---


def test_model_has_mass_limits_and_motors_of_sources():
    model = build("ant-direct", 1).engine.model
    assert float(model.body_mass.sum()) == pytest.approx(0.9109, abs=1e-4)
    low, high = (model.jnt_range[1:, end].reshape(4, 2) for end in (0, 1))
    assert low.tolist() == [pytest.approx([math.radians(-40), math.radians(30)])] * 4
    assert high.tolist() == [pytest.approx([math.radians(40), math.radians(100)])] * 4
    assert model.actuator_gear[:, 0].tolist() == [15.0] * 8
    assert model.dof_damping[6:].tolist() == [0.1] * 8
    assert model.dof_armature[6:].tolist() == [0.01] * 8


def test_legs_are_equal(env):
    """Check that each leg moves as the previous leg, rotated by 90 degrees."""
    for leg in range(4):
        joints = REST.clone()
        joints[2 * leg : 2 * leg + 2] += torch.tensor([0.3, 0.4])
        put(env, leg, joints=joints)
    feet = env.engine.field("xpos")
    env.engine.forward(env._select_all())
    bodies = env.entities["robot"].names["Bodies"]
    ends = [
        feet[leg, env.entities["robot"].body_ids[bodies.index(f"foot_{name}")]]
        for leg, name in enumerate(("fl", "bl", "br", "fr"))
    ]
    for before, after in pairwise(ends):
        turned = torch.stack([-before[1], before[0], before[2]])
        torch.testing.assert_close(after, turned, atol=1e-5, rtol=0)


def test_initial_poses_do_not_penetrate_ground():
    model, data = build("ant-direct", 1).world()
    for hip in (-0.2, 0.0, 0.2):
        for ankle in (-0.2, 0.0, 0.2):
            data.qpos[7::2], data.qpos[8::2] = hip, math.pi / 4 + ankle
            mujoco.mj_forward(model, data)
            assert data.ncon == 0 or data.contact.dist.min() > -2e-3


# --- observations ---


def test_observation_of_height_velocities_and_joints(env):
    joints = REST.clone()
    joints[1], joints[2] = math.radians(100), math.radians(-40)
    put(env, position=(1, 2, 0.6), linear=(3, -2, 1), angular=(0.5, -0.25, 2), joints=joints, rates=2.0)
    seen = observe(env)
    assert [seen[n] for n in ("height", "vel_x", "vel_y", "vel_z")] == pytest.approx([0.6, 3, -2, 1])
    assert [seen[n] for n in ("rate_x", "rate_y", "rate_z")] == pytest.approx([0.5, -0.25, 2])
    assert [seen["ankle_fl_pos"], seen["hip_bl_pos"], seen["hip_fl_pos"]] == pytest.approx([1, -1, 0], abs=1e-6)
    assert seen["ankle_br_pos"] == pytest.approx((45 - 65) / 35, abs=1e-6)
    assert [seen[f"{joint}_vel"] for joint in JOINTS] == pytest.approx([0.4] * 8)


@pytest.mark.parametrize("yaw", [-3.0, -1.5, -0.1, 0.0, 0.7, math.pi / 2, 3.1])
def test_observation_is_in_torso_frame_for_every_yaw(env, yaw):
    put(env, quat=quat_around(3, yaw), linear=(1.0, 0.0, 0.0))
    seen = observe(env)
    assert [seen["vel_x"], seen["vel_y"]] == pytest.approx([math.cos(yaw), -math.sin(yaw)], abs=1e-6)
    assert [seen["yaw"], seen["roll"], seen["target_angle"]] == pytest.approx([yaw, 0.0, -yaw], abs=1e-6)
    assert [seen["up"], seen["heading"]] == pytest.approx([1.0, math.cos(yaw)], abs=1e-6)


@pytest.mark.parametrize("roll", [-2.0, -0.3, 0.0, 1.0, 3.0])
def test_observation_of_roll_and_up(env, roll):
    put(env, quat=quat_around(1, roll))
    seen = observe(env)
    assert [seen["roll"], seen["yaw"], seen["up"]] == pytest.approx([roll, 0.0, math.cos(roll)], abs=1e-6)
    assert seen["heading"] == pytest.approx(1.0)


def test_observation_is_finite_at_vertical_pitch(env):
    for pitch in (math.pi / 2, -math.pi / 2):
        put(env, quat=quat_around(2, pitch))
        assert all(math.isfinite(value) for value in observe(env).values())


def test_target_is_observed_relative_to_position():
    env = build("ant-direct", 2, "params.target=[10.0, 4.0]")
    env.reset()
    put(env, position=(10.0, 1.0, 0.5))  # the target is to the left
    seen = observe(env)
    assert seen["target_angle"] == pytest.approx(math.pi / 2)
    assert seen["heading"] == pytest.approx(0.0, abs=1e-6)


def test_actions_are_observed_and_reset(env):
    action = torch.rand(4, 8) * 2 - 1
    obs = env.step(action).obs["policy"]
    assert torch.equal(obs[:, 52:], action)
    env.episode_length_buf[1] = env.max_episode_length - 1
    obs = env.step(action).obs["policy"]
    assert torch.equal(obs[[0, 2, 3], 52:], action[[0, 2, 3]])
    assert not obs[1, 52:].any()


def test_ankle_forces_carry_body_weight(env):
    idle = torch.zeros(4, 8)
    for _ in range(240):
        result = env.step(idle)
    model, data = env.world(0)
    above = model.body_mass[[i for i in range(model.nbody) if "foot" not in model.body(i).name]].sum()
    lifted = 0.0
    for leg, name in enumerate(("fl", "bl", "br", "fr")):
        force = 10.0 * result.obs["policy"][0, 28 + 6 * leg : 31 + 6 * leg].double().numpy()
        lifted += (data.site(f"robot/ankle_{name}").xmat.reshape(3, 3) @ force)[2]
    assert abs(lifted) == pytest.approx(above * 9.81, rel=0.01)


# --- rewards and terminations ---


def test_only_movement_towards_target_is_progress(env):
    put(env, position=(2.0, 0.0, 0.5))
    reward_and_done(env)
    put(env, position=(2.05, 0.0, 0.5))
    assert reward_and_done(env)[0] == pytest.approx(1.1 + 0.05 * 60, abs=0.01)
    assert float(env.task.speed[0]) == pytest.approx(3.0, abs=0.01)
    put(env, position=(2.05, 0.5, 0.5))
    assert reward_and_done(env)[0] == pytest.approx(1.1, abs=0.02), "sideways is no progress"


def test_first_step_measures_speed_from_initial_position(env):
    env.engine.field("qvel")[:, 0] = 1.2
    env.step(torch.zeros(4, 8))
    assert env.task.speed.tolist() == pytest.approx([1.2] * 4, abs=0.1)
    env.episode_length_buf[0] = env.max_episode_length - 1
    put(env, 0, position=(50.0, 0.0, 0.6))
    env.step(torch.zeros(4, 8))
    env.step(torch.zeros(4, 8))
    assert abs(float(env.task.speed[0])) < 0.5, "the jump from the end of the last episode does not count"


@pytest.mark.parametrize(("yaw", "share"), [(0.5, 1.0), (1.0, math.cos(1.0) / 0.8), (2.0, math.cos(2.0) / 0.8)])
def test_heading_reward(env, yaw, share):
    put(env, quat=quat_around(3, yaw))
    env.task.position_before.zero_()
    env.task.distance_before.fill_(1000.0)
    assert reward_and_done(env)[0] == pytest.approx(0.6 + 0.5 * share, abs=1e-4)


@pytest.mark.parametrize(("roll", "bonus"), [(0.37, 0.1), (0.39, 0.0)])
def test_upright_reward(env, roll, bonus):
    put(env, quat=quat_around(1, roll))
    env.task.position_before.zero_()
    env.task.distance_before.fill_(1000.0)
    assert reward_and_done(env)[0] == pytest.approx(1.0 + bonus, abs=1e-5)


def test_action_and_power_costs(env):
    put(env, rates=torch.tensor([1.0, -2, 3, -4, 5, -6, 7, -8]).double())
    env.task.position_before.zero_()
    env.task.distance_before.fill_(1000.0)
    env.task.actions[0] = torch.tensor([0.1, 0.2, 0.3, 0.4, -0.5, -0.6, -0.7, -0.8])
    squares = sum(0.01 * i * i for i in range(1, 9))
    power = sum(0.1 * i * 0.2 * i for i in range(1, 9))
    assert reward_and_done(env)[0] == pytest.approx(1.1 - 0.005 * squares - 0.05 * power, abs=1e-5)


@pytest.mark.parametrize("end", [-1, 1])
def test_joint_limit_cost(env, end):
    joints = REST.clone()
    joints[0], joints[3] = math.radians(40 * end), math.radians(65 + 35 * end)
    joints[4] = math.radians(0.98 * 40 * end)
    put(env, joints=joints)
    env.task.position_before.zero_()
    env.task.distance_before.fill_(1000.0)
    assert reward_and_done(env)[0] == pytest.approx(1.1 - 2 * 0.1, abs=1e-5)


def test_fall_terminates_and_time_out_truncates(env):
    env.engine.field("qpos")[1, 2] = 0.2
    env.engine.field("qvel")[1, 2] = -3.0
    env.episode_length_buf[2] = 999
    result = env.step(torch.zeros(4, 8))
    assert result.terminated.tolist() == [False, True, False, False]
    assert result.truncated.tolist() == [False, False, True, False]
    assert float(result.reward[1]) == -2.0
    assert env.max_episode_length == 1000


# --- initial states ---


def test_initial_states_fill_ranges():
    env = build("ant-direct", 500)
    env.reset()
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    assert torch.equal(qpos[:, :7], torch.tensor([0, 0, 0.55, 1, 0, 0, 0], dtype=torch.float64).expand(500, 7))
    assert not qvel[:, :6].any()
    for values, centre, span in ((qpos[:, LEGS], REST, 0.2), (qvel[:, 6:], torch.zeros(8).double(), 0.1)):
        away = (values - centre) / span
        assert (away.abs() <= 1.0 + 1e-6).all()
        assert (away.amax(dim=0) > 0.95).all()
        assert (away.amin(dim=0) < -0.95).all()
    assert (qpos[0, LEGS] != qpos[1, LEGS]).all()


def test_initial_joints_are_within_limits():
    env = build("ant-direct", 200, "params.joint_pos_noise=2.0")
    env.reset()
    low, high = env.entities["robot"].data.joint_pos_limits.unbind(dim=1)
    joints = env.entities["robot"].data.joint_pos
    assert ((joints >= low) & (joints <= high)).all()
    assert float(joints[:, 0].max()) > 0.6, "the joint limits bound the range"


# --- on a GPU ---


VIEWS = {"unbind", "slice", "select", "unsqueeze", "view", "expand", "detach", "alias", "as_strided"}
"""Operations that compute nothing."""


def test_hooks_run_few_operations_without_host_sync(env):
    task, action = env.task, torch.rand(4, 8)
    with OperationRecorder() as step:
        task.pre_physics_step(action)
        task.get_observations()
        task.calculate_metrics()
        task.is_done()
    assert not HOST_OPERATIONS & set(step.names)
    assert len([name for name in step.names if name not in VIEWS]) < 68


# --- success ---


@pytest.mark.parametrize(("speed", "succeeds"), [(4.0, True), (0.5, False)])
def test_success_requires_speed_at_end(speed, succeeds):
    env = build("ant-direct", 2, "episode_length_s=1.0", "success.velocity.hold_s=0.5")
    env.reset()
    for _ in range(60):
        env.engine.field("qvel")[:, 0] = speed
        env.engine.field("qpos")[:, 2] = 0.7
        result = env.step(torch.zeros(2, 8))
    assert result.truncated.all()
    assert result.episodes.success.tolist() == [succeeds] * 2


@pytest.mark.slow
def test_hundred_iterations_train_walking(tmp_path):
    command = ["-m", "rlcli", "train", "ant-direct", "--max-iterations", "100", "--runs-dir", str(tmp_path), "--quiet"]
    subprocess.run([sys.executable, *command], check=True)
    (metrics,) = tmp_path.glob("ant-direct/*/metrics.jsonl")
    last = json.loads(metrics.read_text().splitlines()[-1])
    assert last["Task/speed"] > 1.0

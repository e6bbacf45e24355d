"""The task `quadcopter`: model, observations, rewards, terminations, initial states."""

import math

import pytest
import torch
from support.direct_states import observe, quat_around, reward_and_done
from support.flight import hover_for_a_second, put, weight
from support.worlds import build

from rlcli_tasks.quadcopter.task import JOINTS


@pytest.fixture
def env():
    env = build("quadcopter", 4)
    env.reset()
    return env


def act(env, thrust=0.0, tilts=0.0, steps=1):
    """Hold thrusts [N] and tilts [rad] for some steps."""
    for _ in range(steps):
        env.task.thrusts[:] = torch.as_tensor(thrust)
        env.task.tilts[:] = torch.as_tensor(tilts)
        env.step(torch.zeros(env.num_envs, 12))


# --- the model ---


def test_model_has_mass_and_ranges_of_source(env):
    chassis, gimbal, rotor = (
        50 * math.pi * 0.1**2 * 0.03,
        200 * 4 / 3 * math.pi * 0.01**3,
        1000 * math.pi * 0.04**2 * 0.01,
    )
    assert weight(env) / 9.81 == pytest.approx(chassis + 4 * (gimbal + rotor), rel=1e-6)
    limits = env.entities["robot"].data.joint_pos_limits
    assert limits.tolist() == [pytest.approx([-math.pi / 6, math.pi / 6])] * 8
    assert tuple(env.entities["robot"].joint_names) == JOINTS


def test_thrust_equal_to_weight_hovers(env):
    put(env)
    act(env, thrust=weight(env) / 4, steps=100)
    state = env.entities["robot"].data
    assert state.root_lin_vel_w[0].abs().max() < 5e-3
    assert state.root_ang_vel_w[0].abs().max() < 5e-3
    assert state.root_pos_w[0].tolist() == pytest.approx([0, 0, 1], abs=5e-3)


def test_full_thrust_bends_gimbal_less_than_a_degree(env):
    put(env)
    act(env, thrust=[2.0, 0.0, 0.0, 0.0], steps=5)
    bent = env.entities["robot"].data.joint_pos[0].abs().max()
    assert 0.0 < bent < math.radians(1.0)


def test_servos_reach_target_tilt_within_tenth_of_second(env):
    put(env)
    asked = torch.tensor([0.5, -0.5, 0.3, 0.2, -0.2, 0.1, 0.0, -0.4])
    act(env, thrust=weight(env) / 4, tilts=asked, steps=10)
    assert env.entities["robot"].data.joint_pos[0].tolist() == pytest.approx(asked.tolist(), abs=0.05)


def test_equal_rotor_tilts_yaw_without_drift(env):
    put(env)
    act(env, thrust=weight(env) / 4, tilts=[0.0, 0.3] * 4, steps=15)
    state = env.entities["robot"].data
    assert state.root_ang_vel_w[0, 2] < -1.0, "a rotor rolled about its arm pushes clockwise"
    assert state.root_lin_vel_w[0, :2].abs().max() < 1e-2


def test_more_front_thrust_pitches_up_and_moves_back(env):
    put(env)
    quarter = weight(env) / 4
    act(env, thrust=[quarter * 1.1, quarter * 0.9, quarter * 0.9, quarter * 1.1], steps=20)
    state = env.entities["robot"].data
    assert state.root_ang_vel_w[0, 1] < -0.5
    assert state.root_lin_vel_w[0, 0] < -0.01


def test_random_actions_keep_simulation_stable():
    env = build("quadcopter", 256)
    env.reset()
    generator = torch.Generator().manual_seed(0)
    beyond = 0.0
    for _ in range(150):
        env.step((torch.rand(256, 12, generator=generator) * 2 - 1).sign())
        beyond = max(beyond, float(env.entities["robot"].data.joint_pos.abs().max()) - math.pi / 6)
    assert env.divergences == 0
    assert beyond < 0.1


# --- actions and observations ---


def test_actions_are_rates_with_limits(env):
    task = env.task
    task.tilts.zero_()
    action = torch.zeros(4, 12)
    action[0, :8], action[0, 8:] = 0.5, 0.25
    action[1] = 1.0
    action[2] = -1.0
    task.pre_physics_step(action)
    assert task.tilts[0].tolist() == pytest.approx([0.01 * 8 * math.pi * 0.5] * 8)
    assert task.thrusts[0].tolist() == pytest.approx([0.25] * 4)
    for _ in range(5):
        task.pre_physics_step(action)
    assert task.thrusts[0].tolist() == pytest.approx([1.5] * 4)
    assert task.thrusts[1:3].tolist() == [[2.0] * 4, [-2.0] * 4]
    assert task.tilts[1].tolist() == pytest.approx([math.pi / 6] * 8)
    assert env.engine.field("ctrl")[1].tolist() == pytest.approx([math.pi / 6] * 8 + [2.0] * 4)


def test_observation_units(env):
    joints = torch.linspace(-0.4, 0.4, 8).double()
    put(
        env,
        position=(0.3, -0.6, 1.9),
        quat=quat_around(3, 0.5),
        linear=(1, 2, -3),
        angular=(0, 0, math.pi),
        joints=joints,
    )
    seen = observe(env)
    assert [seen[f"to_target_{x}"] for x in "xyz"] == pytest.approx([-0.1, 0.2, -0.3])
    assert [seen[f"quat_{x}"] for x in "wxyz"] == pytest.approx(list(quat_around(3, 0.5)))
    assert [seen[f"vel_{x}"] for x in "xyz"] == pytest.approx([0.5, 1.0, -1.5])
    assert [seen[f"rate_{x}"] for x in "xyz"] == pytest.approx([0, 0, 1], abs=1e-6)
    assert [seen[f"{joint}_pos"] for joint in JOINTS] == pytest.approx(joints.tolist())


def test_rates_are_in_world_frame(env):
    put(env, quat=quat_around(1, math.pi / 2), angular=(0.0, 1.0, 0.0))  # its y axis points up
    seen = observe(env)
    assert [seen[f"rate_{x}"] for x in "xyz"] == pytest.approx([0, 0, 1 / math.pi], abs=1e-6)


# --- rewards and ends ---


def test_hovering_at_target_is_rewarded_with_three(env):
    put(env)
    assert reward_and_done(env) == (pytest.approx(3.0), False)


@pytest.mark.parametrize("distance", [0.1, 0.5, 1.0, 2.0])
def test_nearness_scales_reward(env, distance):
    put(env, position=(distance, 0.0, 1.0))
    assert reward_and_done(env)[0] == pytest.approx(3.0 / (1.0 + 3.0 * distance**2), rel=1e-5)


@pytest.mark.parametrize(("axis", "tilt"), [(1, 0.5), (2, -1.0), (1, 3.0)])
def test_tilt_reduces_reward_in_every_direction(env, axis, tilt):
    put(env, quat=quat_around(axis, tilt))
    assert reward_and_done(env)[0] == pytest.approx(2.0 + 1.0 / (1.0 + 10.0 * (1.0 - math.cos(tilt)) ** 2), rel=1e-5)


@pytest.mark.parametrize("spin", [-2.0, 10.0])
def test_spin_reduces_reward_in_both_directions(env, spin):
    put(env, angular=(0, 0, spin))
    assert reward_and_done(env)[0] == pytest.approx(2.0 + 1.0 / (1.0 + 0.001 * spin**2) - spin**2 / 400.0, rel=1e-5)


def test_reward_is_never_negative(env):
    put(env, angular=(0, 0, 60.0))
    assert reward_and_done(env)[0] == 0.0


@pytest.mark.parametrize(
    ("position", "ends"),
    [((0, 0, 0.299), True), ((0, 0, 0.301), False), ((2.99, 0, 1), False), ((0, -3.01, 1), True), ((0, 0, 4.01), True)],
)
def test_terminates_too_low_or_too_far(env, position, ends):
    put(env, position=position)
    assert reward_and_done(env)[1] is ends


def test_time_out_after_500_steps(env):
    assert env.max_episode_length == 500
    env.episode_length_buf[2] = 499
    result = env.step(torch.zeros(4, 12))
    assert result.truncated.tolist() == [False, False, True, False]
    assert not result.terminated.any()


# --- starts ---


def test_initial_states_fill_ranges():
    env = build("quadcopter", 500)
    env.reset()
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    low, high = (
        torch.tensor([-1.5, -1.5, 0.8] + [-0.2] * 8).double(),
        torch.tensor([1.5, 1.5, 2.5] + [0.2] * 8).double(),
    )
    share = (torch.cat([qpos[:, :3], qpos[:, 7:]], dim=1) - low) / (high - low)
    assert (share > -1e-6).all()
    assert (share < 1 + 1e-6).all()
    assert (share.amin(dim=0) < 0.02).all()
    assert (share.amax(dim=0) > 0.98).all()
    assert torch.equal(qpos[:, 3:7], torch.tensor([1.0, 0, 0, 0]).double().expand(500, 4))
    assert not qvel.any()


def test_initial_thrust_is_zero_and_tilts_are_sampled(env):
    env.task.thrusts.fill_(1.0)
    env.episode_length_buf[1] = 499
    env.step(torch.zeros(4, 12))
    assert env.task.thrusts.tolist() == [[1.0] * 4, [0.0] * 4, [1.0] * 4, [1.0] * 4]
    torch.testing.assert_close(env.task.tilts[1], env.entities["robot"].data.joint_pos[1])


# --- success ---


@pytest.mark.parametrize(
    ("offset", "velocity", "succeeds"),
    [((0.05, 0, 0), (0, 0, 0), True), ((0, 0, 0.15), (0, 0, 0), False), ((0, 0, 0), (0.8, 0, 0), False)],
)
def test_success_requires_hovering_until_end(offset, velocity, succeeds):
    env = build("quadcopter", 2, "episode_length_s=1.0")
    assert hover_for_a_second(env, offset, velocity) == [succeeds] * 2

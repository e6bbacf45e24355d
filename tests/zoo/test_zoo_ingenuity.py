"""The task `ingenuity`: model, rotors, observations, rewards, terminations, initial states."""

import math

import pytest
import torch
from support.direct_states import observe, quat_around, reward_and_done
from support.flight import hover_for_a_second, put, weight
from support.worlds import build

LOWER_X, LOWER_Y, LOWER, UPPER_X, UPPER_Y, UPPER = range(6)


UPSTREAM = ("params.steadiness=0", "params.max_distance=20")
"""The task as it is; the CPU's agent trains with others."""


@pytest.fixture
def env():
    env = build("ingenuity", 4, *UPSTREAM)
    env.reset()
    return env


def fly(env, steps, **columns):
    """Hold an action that carries the weight, with some columns set."""
    action = torch.zeros(env.num_envs, 6)
    action[:, [LOWER, UPPER]] = weight(env) / 40.0
    for name, value in columns.items():
        action[:, env.task.action_names.index(name)] = value
    for _ in range(steps):
        env.step(action)


# --- the model ---


def test_mass_and_gravity_equal_source(env):
    chassis, rotor = 50 * 0.12**3, 1000 * math.pi * 0.15**2 * 0.01
    assert weight(env) == pytest.approx((chassis + 2 * rotor) * 3.721, rel=1e-6)
    assert env.engine.model.opt.gravity.tolist() == [0, 0, -3.721]


def test_thrust_equal_to_weight_hovers(env):
    put(env)
    fly(env, 100)
    data = env.entities["robot"].data
    assert data.root_pos_w[0].tolist() == pytest.approx([0, 0, 1], abs=1e-4)
    assert data.root_lin_vel_w[0].abs().max() < 1e-4


def test_full_thrust_is_20_newton_per_rotor(env):
    put(env)
    env.step(torch.tensor([[0, 0, 1.0, 0, 0, 1.0]]).expand(4, 6))
    mass = weight(env) / 3.721
    assert float(env.entities["robot"].data.root_lin_vel_w[0, 2]) == pytest.approx(0.01 * (40 / mass - 3.721), rel=1e-4)


def test_sideways_force_is_at_most_fifth_of_thrust(env):
    action = torch.zeros(4, 6)
    action[0] = torch.tensor([1.0, -0.5, 0.5, 0.0, 1.0, -1.0])
    env.step(action)
    assert env.engine.field("ctrl")[0].tolist() == pytest.approx([2.0, -1.0, 10.0, 0.0, -4.0, -20.0])
    assert not env.engine.field("ctrl")[1:].any()


@pytest.mark.parametrize(("columns", "way"), [(("lower_x", "upper_x"), 0), (("lower_y", "upper_y"), 1)])
def test_equal_sideways_forces_move_robot(env, columns, way):
    put(env)
    fly(env, 10, **dict.fromkeys(columns, 0.5))
    data = env.entities["robot"].data
    expected = 0.1 * 0.1 * 3.721  # a tenth of the weight for a tenth of a second
    assert float(data.root_lin_vel_w[0, way]) == pytest.approx(expected, rel=0.02)
    assert data.root_ang_vel_w[0].abs().max() < 0.15


@pytest.mark.parametrize(("kind", "axis", "sign"), [("x", 1, 1), ("y", 0, -1)])
def test_opposite_sideways_forces_tilt_robot(env, kind, axis, sign):
    put(env)
    fly(env, 20, **{f"upper_{kind}": 1.0, f"lower_{kind}": -1.0})
    data = env.entities["robot"].data
    assert float(data.root_ang_vel_w[0, axis]) * sign > 0.1
    assert data.root_lin_vel_w[0, :2].abs().max() < 0.05


def test_rotor_force_is_in_rotor_frame(env):
    put(env, quat=quat_around(2, 0.5))
    fly(env, 10)
    drift = float(env.entities["robot"].data.root_lin_vel_w[0, 0])
    assert drift == pytest.approx(0.1 * 3.721 * math.sin(0.5), rel=0.02)


# --- observations ---


def test_observation_units(env):
    put(env, position=(0.3, -0.6, 1.9), quat=quat_around(3, 0.5), linear=(1, 2, -3), angular=(0, 0, math.pi))
    env.task.target[0] = torch.tensor([0.0, 0.0, 1.0])
    seen = observe(env)
    assert [seen[f"to_target_{x}"] for x in "xyz"] == pytest.approx([-0.1, 0.2, -0.3])
    assert [seen[f"quat_{x}"] for x in "wxyz"] == pytest.approx(list(quat_around(3, 0.5)))
    assert [seen[f"vel_{x}"] for x in "xyz"] == pytest.approx([0.5, 1.0, -1.5])
    assert [seen[f"rate_{x}"] for x in "xyz"] == pytest.approx([0, 0, 1], abs=1e-6)


# --- targets ---


def test_target_changes_every_five_seconds():
    env = build("ingenuity", 100, "params.min_height=-1000", "params.max_distance=1000")
    env.reset()
    assert env.task.targets.shape == (100, 4, 3)
    every = env.task.targets.reshape(-1, 3)
    assert every.amin(dim=0).tolist() == pytest.approx([-1, -1, 1], abs=0.05)
    assert every.amax(dim=0).tolist() == pytest.approx([1, 1, 2], abs=0.05)
    for progress, phase in ((0, 0), (499, 0), (500, 1), (1499, 2), (1500, 3), (1999, 3)):
        env.task.progress_buf.fill_(progress)
        env.step(torch.zeros(100, 6))
        assert torch.equal(env.task.target, env.task.targets[:, phase]), progress
        torch.testing.assert_close(env.entities["target"].data.root_pos_w, env.task.target)


def test_new_episode_observes_new_target(env):
    before = env.task.target.clone()
    env.episode_length_buf[1] = env.max_episode_length - 1
    obs = env.step(torch.zeros(4, 6)).obs["policy"]
    assert (env.task.target[1] != before[1]).all()
    assert torch.equal(env.task.target[[0, 2, 3]], before[[0, 2, 3]])
    place = env.entities["robot"].data.root_pos_w
    torch.testing.assert_close(obs[:, :3] * 3, env.task.target - place)
    torch.testing.assert_close(env.entities["target"].data.root_pos_w, env.task.target)


# --- rewards and ends ---


def at_target(env, offset=(0.0, 0.0, 0.0), **state):
    env.task.target[0] = torch.tensor([0.0, 0.0, 1.5])
    put(env, position=(offset[0], offset[1], 1.5 + offset[2]), **state)


def test_hovering_at_target_is_rewarded_with_three(env):
    at_target(env)
    assert reward_and_done(env) == (pytest.approx(3.0), False)


@pytest.mark.parametrize("distance", [0.1, 1.0, 5.0])
def test_nearness_scales_reward(env, distance):
    at_target(env, (0.0, distance, 0.0))
    assert reward_and_done(env)[0] == pytest.approx(3.0 / (1.0 + 2.5 * distance**2), rel=1e-5)


@pytest.mark.parametrize(("axis", "tilt"), [(1, 0.5), (2, -1.0)])
def test_tilt_reduces_reward_in_every_direction(env, axis, tilt):
    at_target(env, quat=quat_around(axis, tilt))
    assert reward_and_done(env)[0] == pytest.approx(2.0 + 1.0 / (1.0 + 30.0 * (1.0 - math.cos(tilt)) ** 2), rel=1e-5)


@pytest.mark.parametrize("spin", [-0.5, 2.0])
def test_spin_reduces_reward_in_both_directions(env, spin):
    at_target(env, angular=(0, 0, spin))
    assert reward_and_done(env)[0] == pytest.approx(2.0 + 1.0 / (1.0 + 10.0 * spin**2), rel=1e-5)


def test_steadiness_rewards_rest_near_target():
    env = build("ingenuity", 4, "params.steadiness=2")
    env.reset()
    at_target(env, (0.0, 1.0, 0.0))
    assert reward_and_done(env)[0] == pytest.approx(5.0 / 3.5, rel=1e-5)
    at_target(env, (0.0, 1.0, 0.0), linear=(0.3, 0.0, -0.4))
    assert reward_and_done(env)[0] == pytest.approx((3.0 + 2.0 / 3.5) / 3.5, rel=1e-5)


@pytest.mark.parametrize(
    ("position", "ends"),
    [((0, 0, 0.499), True), ((0, 0, 0.501), False), ((19.9, 0, 1.5), False), ((0, 20.1, 1.5), True)],
)
def test_terminates_too_low_or_too_far(env, position, ends):
    env.task.target[0] = torch.tensor([0.0, 0.0, 1.5])
    put(env, position=position)
    assert reward_and_done(env)[1] is ends


# --- starts ---


def test_initial_states_fill_ranges():
    env = build("ingenuity", 300)
    env.reset()
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    offset = qpos[:, :3] - torch.tensor([0.0, 0.0, 1.0])
    assert (offset.abs() <= 0.5 + 1e-6).all()
    assert offset.amax(dim=0).min() > 0.48
    assert offset.amin(dim=0).max() < -0.48
    assert torch.equal(qpos[:, 3:7], torch.tensor([1.0, 0, 0, 0]).double().expand(300, 4))
    assert not qvel.any()
    assert env.max_episode_length == 2000


def test_lowest_initial_state_can_recover(env):
    put(env, position=(0.0, 0.0, 0.5001))
    result = env.step(torch.tensor([[0, 0, 1.0, 0, 0, 1.0]]).expand(4, 6))
    assert not bool(result.terminated[0])


# --- success ---


@pytest.mark.parametrize(
    ("offset", "velocity", "succeeds"),
    [((0.1, 0, 0), (0, 0, 0), True), ((0, 0.35, 0), (0, 0, 0), False), ((0, 0, 0), (0, 0, 0.6), False)],
)
def test_success_requires_hovering_until_end(offset, velocity, succeeds):
    env = build("ingenuity", 2, "episode_length_s=1.0")
    assert hover_for_a_second(env, offset, velocity) == [succeeds] * 2

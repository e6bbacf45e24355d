"""The task `crazyflie`: model, motors, observations, rewards, terminations, initial states."""

import math

import pytest
import torch
from support.direct_states import observe, quat_around, reward_and_done
from support.flight import hover_for_a_second, put, weight
from support.worlds import build

HOVER = 2.0 / 1.9 - 1.0
"""Action at which four motors carry the weight."""


@pytest.fixture
def env():
    env = build("crazyflie", 4, "params.thrust_noise=0.0")
    env.reset()
    return env


def fly(env, action, steps, settled=True):
    """Hold an action; with `settled`, motors have the commanded speed from the start."""
    action = torch.as_tensor(action).expand(env.num_envs, 4)
    if settled:
        env.task.speeds.copy_(((action + 1) / 2).sqrt())
    for _ in range(steps):
        env.step(action)


# --- the model and its motors ---


def test_mass_and_inertia(env):
    model = env.engine.model
    body = env.entities["robot"].root_body
    assert weight(env) == pytest.approx(0.028 * 9.81)
    assert model.body_inertia[body].tolist() == pytest.approx([25 * 16.6e-6, 25 * 16.6e-6, 25 * 29.3e-6], rel=1e-6)
    places = torch.from_numpy(model.site_pos[env.entities["robot"].site_ids])
    assert places.norm(dim=1).tolist() == pytest.approx([5 * 0.046] * 4, rel=1e-4)
    assert places[:, :2].sign().tolist() == [[1, -1], [-1, -1], [-1, 1], [1, 1]]


def test_full_thrust_acceleration(env):
    put(env)
    fly(env, 1.0, 10)
    assert float(env.entities["robot"].data.root_lin_vel_w[0, 2]) == pytest.approx(0.1 * 0.9 * 9.81, rel=1e-3)


def test_thrust_equal_to_weight_hovers(env):
    put(env, position=(0, 0, 2))
    fly(env, HOVER, 100)
    data = env.entities["robot"].data
    assert data.root_pos_w[0].tolist() == pytest.approx([0, 0, 2], abs=1e-3)
    assert data.root_lin_vel_w[0].abs().max() < 1e-3


def test_motors_lag_and_thrust_is_square_of_speed(env):
    share = 4 * 0.01 / 0.15
    fly(env, 0.28, 1, settled=False)  # commands 0.64 of the thrust: 0.8 of the speed
    for step in range(1, 10):
        expected = 0.8 * (1 - (1 - share) ** step)
        assert env.task.speeds[0].tolist() == pytest.approx([expected] * 4, rel=1e-5)
        thrust = env.engine.field("ctrl")[0]
        assert thrust.tolist() == pytest.approx([expected**2 * 1.9 * weight(env) / 4] * 4, rel=1e-5)
        fly(env, 0.28, 1, settled=False)


def test_motor_without_command_stops(env):
    put(env)
    fly(env, 1.0, 1)
    fly(env, -1.0, 40, settled=False)
    assert env.task.speeds.max() < 1e-4
    assert env.engine.field("ctrl").min() >= 0.0


@pytest.mark.parametrize(
    ("strong", "axis", "turn", "drift"),
    [((0, 1), 0, -1, (1, 1)), ((2, 3), 0, 1, (1, -1)), ((0, 3), 1, -1, (0, -1)), ((1, 2), 1, 1, (0, 1))],
    ids=["right", "left", "front", "back"],
)
def test_unequal_motors_tilt_and_move(env, strong, axis, turn, drift):
    put(env, position=(0, 0, 2))
    action = torch.full((4,), HOVER - 0.05)
    action[list(strong)] += 0.1
    fly(env, action, 20)
    data = env.entities["robot"].data
    assert float(data.root_ang_vel_w[0, axis]) * turn > 0.5
    way, sign = drift
    assert float(data.root_lin_vel_w[0, way]) * sign > 0.01


def test_thrust_noise_is_one_percent_per_motor_and_step():
    env = build("crazyflie", 200)
    env.reset()
    noises = []
    for _ in range(20):
        fly(env, 0.0, 1)
        noises.append(env.engine.field("ctrl") / (1.9 * weight(env) / 4) - 0.5)
    noise = torch.stack(noises)  # (steps, envs, motors)
    assert noise.std().item() == pytest.approx(0.005, rel=0.05)
    assert abs(noise.mean().item()) < 2e-4
    for own in (noise[0] - noise[1], noise[:, 0] - noise[:, 1], noise[:, :, 0] - noise[:, :, 1]):
        assert own.std().item() == pytest.approx(0.005 * math.sqrt(2), rel=0.15), "two that are drawn apart"


def test_noise_does_not_depend_on_num_envs():
    def thrusts(num_envs, seed):
        env = build("crazyflie", num_envs, seed=seed)
        env.reset()
        fly(env, 0.0, 5, settled=False)
        return env.engine.field("ctrl")[:2].clone()

    assert torch.equal(thrusts(2, 1), thrusts(7, 1))
    assert not torch.equal(thrusts(2, 1), thrusts(2, 2))


# --- observations ---


def test_observation_of_state(env):
    put(env, position=(0.5, -1.0, 1.25), quat=quat_around(3, math.pi / 2), linear=(1, 2, -3), angular=(0.5, 0.25, -1))
    seen = observe(env)
    assert [seen[f"to_target_{x}"] for x in "xyz"] == pytest.approx([-0.5, 1.0, 0.75])
    assert [seen[f"x_axis_{x}"] for x in "xyz"] == pytest.approx([0, 1, 0], abs=1e-6)
    assert [seen[f"y_axis_{x}"] for x in "xyz"] == pytest.approx([-1, 0, 0], abs=1e-6)
    assert [seen[f"z_axis_{x}"] for x in "xyz"] == pytest.approx([0, 0, 1], abs=1e-6)
    assert [seen[f"vel_{x}"] for x in "xyz"] == pytest.approx([1, 2, -3])
    assert [seen[f"rate_{x}"] for x in "xyz"] == pytest.approx([-0.25, 0.5, -1], abs=1e-6)


# --- targets ---


def test_first_target_is_two_metres_high(env):
    assert env.task.target.tolist() == [[0, 0, 2]] * 4
    assert env.entities["target"].data.root_pos_w.tolist() == [[0, 0, 2]] * 4


def test_targets_are_resampled_every_period():
    box = ("params.target_low=[-1,-1,1]", "params.target_high=[1,1,3]")
    env = build(
        "crazyflie", 100, *box, "params.target_period=5", "params.max_distance=100", "params.height_range=[-9,9]"
    )
    env.reset()
    seen = []
    for step in range(15):
        env.step(torch.zeros(100, 4))
        if step % 5 == 0:
            seen.append(env.task.target.clone())
        assert torch.equal(env.task.target, seen[-1])
        torch.testing.assert_close(env.entities["target"].data.root_pos_w, env.task.target)
    for before, after in ((0, 1), (1, 2), (0, 2)):
        assert (seen[before] != seen[after]).all()
    every = torch.cat(seen)
    assert every.amin(dim=0).tolist() == pytest.approx([-1, -1, 1], abs=0.05)
    assert every.amax(dim=0).tolist() == pytest.approx([1, 1, 3], abs=0.05)


# --- rewards and ends ---


def test_reward_of_hovering_at_target(env):
    put(env, position=(0, 0, 2))
    env.task.actions.zero_()
    assert reward_and_done(env) == (pytest.approx(1.0 + 1.0 + 0.01 - 0.05), False)


@pytest.mark.parametrize("distance", [0.25, 1.0, 2.0])
def test_nearness_scales_posture_and_stillness(env, distance):
    put(env, position=(distance, 0, 2))
    env.task.actions.fill_(1.0)
    assert reward_and_done(env)[0] == pytest.approx(2.01 / (1 + distance) - 0.05 * math.exp(-2.0), rel=1e-5)


@pytest.mark.parametrize(("tilt", "share"), [(1.0, math.cos(1.0)), (2.0, 0.0)])
def test_posture_reward_is_cosine_of_tilt(env, tilt, share):
    put(env, position=(0, 0, 2), quat=quat_around(2, tilt))
    env.task.actions.fill_(10.0)  # makes the cost vanish
    assert reward_and_done(env)[0] == pytest.approx(1.01 + share, rel=1e-5)


def test_rotation_removes_stillness_reward(env):
    put(env, position=(0, 0, 2), angular=(0.5, 1.0, -0.5))
    env.task.actions.fill_(10.0)
    assert reward_and_done(env)[0] == pytest.approx(2.0 + 0.01 * math.exp(-1.5), rel=1e-6)


@pytest.mark.parametrize(
    ("position", "quat", "ends"),
    [
        ((0, 0, 0.49), quat_around(1, 0.0), True),
        ((0, 0, 0.51), quat_around(1, 0.0), False),
        ((0, 0, 4.99), quat_around(1, 0.0), False),
        ((0, 0, 5.01), quat_around(1, 0.0), True),
        ((4.99, 0, 2), quat_around(1, 0.0), False),
        ((0, 5.01, 2), quat_around(1, 0.0), True),
        ((0, 0, 2), quat_around(1, 1.5), False),
        ((0, 0, 2), quat_around(2, 1.6), True),
    ],
)
def test_terminates_too_far_low_high_or_upside_down(env, position, quat, ends):
    put(env, position=position, quat=quat)
    assert reward_and_done(env)[1] is ends


# --- starts ---


def test_initial_states_fill_ranges_with_motors_off():
    env = build("crazyflie", 300)
    env.reset()
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    offset = qpos[:, :3] - torch.tensor([0.0, 0.0, 1.0])
    assert (offset.abs() <= 0.3 + 1e-6).all()
    assert offset.amax(dim=0).min() > 0.28
    assert offset.amin(dim=0).max() < -0.28
    assert torch.equal(qpos[:, 3:7], torch.tensor([1.0, 0, 0, 0]).double().expand(300, 4))
    assert not qvel.any()
    assert not env.task.speeds.any()


def test_motors_and_action_are_reset(env):
    fly(env, 0.5, 3)
    env.episode_length_buf[1] = env.max_episode_length - 1
    fly(env, 0.5, 1, settled=False)
    assert not env.task.speeds[1].any()
    assert not env.task.actions[1].any()
    assert (env.task.speeds[[0, 2, 3]] > 0.8).all()
    assert env.max_episode_length == 700


# --- success ---


@pytest.mark.parametrize(
    ("offset", "velocity", "succeeds"),
    [((0.1, 0, 0), (0, 0, 0), True), ((0, 0.2, 0), (0, 0, 0), False), ((0, 0, 0), (0, 0, 0.6), False)],
)
def test_success_requires_hovering_until_end(offset, velocity, succeeds):
    env = build("crazyflie", 2, "episode_length_s=1.0")
    assert hover_for_a_second(env, offset, velocity) == [succeeds] * 2

"""The task `cart-double-pendulum`: model, observations, rewards, terminations, initial states."""

import math

import mujoco
import pytest
import torch
from support.direct_states import observe, reward_and_done
from support.worlds import actions, build

from rlcli.mdp import observations

TASK = "cart-double-pendulum"


@pytest.fixture
def env():
    env = build(TASK, 3)
    env.reset()
    return env


def put(env, row=0, positions=(0.0, 0.0, 0.0), velocities=(0.0, 0.0, 0.0)):
    """Set the state of one environment: cart, pole, pendulum."""
    env.engine.field("qpos")[row] = torch.tensor(positions).double()
    env.engine.field("qvel")[row] = torch.tensor(velocities).double()
    env.sim.refresh()


def test_masses_and_geometry():
    model, data = build(TASK, 1).world()
    assert [float(model.body(f"robot/{name}").mass[0]) for name in ("cart", "pole", "pendulum")] == [1.0, 1.0, 1.0]
    data.qpos[:] = 0.0
    mujoco.mj_forward(model, data)
    heights = [float(data.body(f"robot/{name}").xipos[2]) for name in ("cart", "pole", "pendulum")]
    assert heights == pytest.approx([2.0, 2.47, 2.0 + 0.94 + 0.47])
    assert data.ncon == 0


def test_actions_push_cart_and_turn_pendulum(env):
    for force, torque in ((1.0, 0.0), (0.0, 1.0), (-0.5, 0.25)):
        env.step(torch.tensor([[force, torque]]).repeat(3, 1))
        efforts = env.entities["robot"].data.applied_effort[0].tolist()
        assert efforts == pytest.approx([100.0 * force, 0.0, 50.0 * torque])


def test_actions_are_clipped_to_one(env):
    env.step(torch.full((3, 2), 7.0))
    assert env.entities["robot"].data.applied_effort[0].tolist() == pytest.approx([100.0, 0.0, 50.0])


def test_observation_of_cart_and_pendulum(env):
    put(env, positions=(0.5, 0.3, -0.4), velocities=(1.0, -2.0, 3.0))
    assert observe(env) == pytest.approx(
        {"cart_pos": 0.5, "cart_vel": 1.0, "pole_pos": 0.3, "pole_vel": -2.0}
        | {"pendulum_tilt": -0.1, "pendulum_pos": -0.4, "pendulum_vel": 3.0}
    )


@pytest.mark.parametrize("turns", [-2, 1, 3])
def test_full_turns_do_not_change_obs_and_reward(env, turns):
    put(env, 0, (0.0, 0.2, 0.5))
    put(env, 1, (0.0, 0.2, 0.5 + 2 * math.pi * turns))
    assert observe(env, 0) == pytest.approx(observe(env, 1), abs=1e-5)
    assert reward_and_done(env, 0)[0] == pytest.approx(reward_and_done(env, 1)[0], abs=1e-5)


def test_tilt_wraps_at_half_turn(env):
    put(env, positions=(0.0, 1.0, 3.0))
    assert observe(env)["pendulum_tilt"] == pytest.approx(4.0 - 2 * math.pi)
    assert reward_and_done(env)[0] == pytest.approx(2.0 - 1.0 - (4.0 - 2 * math.pi) ** 2, abs=1e-4)


def test_upright_and_still_is_rewarded_with_two(env):
    put(env, positions=(2.0, 0.0, 0.0))
    assert reward_and_done(env) == (2.0, False)


def test_tilt_and_speed_costs(env):
    put(env, positions=(0.0, 0.3, -0.5), velocities=(2.0, -3.0, 4.0))
    assert reward_and_done(env)[0] == pytest.approx(2.0 - 0.09 - 0.04 - 0.01 * 9.0, abs=1e-6)


@pytest.mark.parametrize(
    ("positions", "failed"),
    [
        ((2.99, 0, 0), False),
        ((3.01, 0, 0), True),
        ((-3.01, 0, 0), True),
        ((0, 1.56, -1.56), False),
        ((0, -1.58, 0), True),
    ],
)
def test_terminates_off_rail_or_pole_down(env, positions, failed):
    put(env, positions=positions)
    reward, ended = reward_and_done(env)
    assert ended is failed
    tilts = positions[1] ** 2 + (positions[1] + positions[2]) ** 2
    assert reward == pytest.approx((-4.0 if failed else 2.0) - tilts, abs=1e-5)


def test_hanging_pendulum_does_not_terminate(env):
    put(env, positions=(0.0, 0.0, math.pi))
    assert reward_and_done(env)[1] is False


def test_initial_states_fill_ranges():
    env = build(TASK, 500)
    env.reset()
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    assert not qvel.any()
    assert not qpos[:, 0].any()
    for column in (1, 2):
        assert float(qpos[:, column].abs().max()) <= math.pi / 4 + 1e-6
        assert float(qpos[:, column].max()) > 0.95 * math.pi / 4
        assert float(qpos[:, column].min()) < -0.95 * math.pi / 4
    assert float(torch.corrcoef(qpos[:, 1:].T)[0, 1].abs()) < 0.2


def test_time_out_after_five_seconds(env):
    assert env.max_episode_length == 300
    env.episode_length_buf[1] = 299
    put(env, 1)
    result = env.step(torch.zeros(3, 2))
    assert result.truncated.tolist() == [False, True, False]
    assert not result.terminated[1]


@pytest.mark.parametrize(("pendulum", "succeeds"), [(0.05, True), (0.2, False)])
def test_success_requires_upright_links(pendulum, succeeds):
    env = build(TASK, 1, "episode_length_s=1.0", "success.pole.hold_s=0.5", "success.pendulum.hold_s=0.5")
    env.reset()
    while True:
        put(env, positions=(0.0, 0.0, pendulum))
        result = env.step(torch.zeros(1, 2))
        if bool(result.truncated[0]):
            break
    assert result.episodes.success.tolist() == [succeeds]


def test_terms_equal_hooks():
    env = build(TASK, 4)
    env.reset()
    terms = env.task.in_terms()
    for action in actions(30, 4, 2):
        env.step(action)
        env.task.get_observations()
        parts = [term_value(env, **term) for term in terms["observations"]]
        torch.testing.assert_close(torch.cat(parts, dim=1), env.task.obs_buf, atol=1e-6, rtol=0)


def term_value(env, func, joints):
    """Return the value of an observation term of rlcli.mdp for some joints."""
    robot = env.entities["robot"]
    columns, _ = robot.select("Joints", joints)
    return getattr(observations, func)(env, entity=robot, joints=columns)

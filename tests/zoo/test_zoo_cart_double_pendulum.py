"""The task `cart-double-pendulum`: its model, what it observes, what it pays, where it ends, how it starts."""

import math

import mujoco
import pytest
import torch
from support.worlds import actions, build

from rlcli.mdp import observations

TASK = "cart-double-pendulum"


@pytest.fixture
def env():
    env = build(TASK, 3)
    env.reset()
    return env


def put(env, row=0, positions=(0.0, 0.0, 0.0), velocities=(0.0, 0.0, 0.0)):
    """Put one environment into a state: cart, pole, pendulum."""
    env.engine.field("qpos")[row] = torch.tensor(positions).double()
    env.engine.field("qvel")[row] = torch.tensor(velocities).double()
    env.sim.refresh()


def look(env, row=0):
    """Column name -> value of the observation."""
    env.task.get_observations()
    return dict(zip(env.task.observation_names, env.task.obs_buf[row].tolist(), strict=True))


def pay(env, row=0):
    """Reward of the state as it is, and whether it ends the episode."""
    env.task.get_observations()
    env.task.calculate_metrics()
    env.task.is_done()
    return float(env.task.rew_buf[row]), bool(env.task.reset_buf[row])


def test_cart_pole_and_pendulum_weigh_a_kilogram_each_and_stand_on_one_another():
    model, data = build(TASK, 1).world()
    assert [float(model.body(f"robot/{name}").mass[0]) for name in ("cart", "pole", "pendulum")] == [1.0, 1.0, 1.0]
    data.qpos[:] = 0.0
    mujoco.mj_forward(model, data)
    heights = [float(data.body(f"robot/{name}").xipos[2]) for name in ("cart", "pole", "pendulum")]
    assert heights == pytest.approx([2.0, 2.47, 2.0 + 0.94 + 0.47])
    assert data.ncon == 0


def test_the_first_action_pushes_the_cart_and_the_second_turns_the_pendulum_against_the_pole(env):
    for force, torque in ((1.0, 0.0), (0.0, 1.0), (-0.5, 0.25)):
        env.step(torch.tensor([[force, torque]]).repeat(3, 1))
        efforts = env.entities["robot"].data.applied_effort[0].tolist()
        assert efforts == pytest.approx([100.0 * force, 0.0, 50.0 * torque])


def test_actions_are_clipped_to_one(env):
    env.step(torch.full((3, 2), 7.0))
    assert env.entities["robot"].data.applied_effort[0].tolist() == pytest.approx([100.0, 0.0, 50.0])


def test_the_observation_is_what_the_cart_and_the_pendulum_see(env):
    put(env, positions=(0.5, 0.3, -0.4), velocities=(1.0, -2.0, 3.0))
    assert look(env) == pytest.approx(
        {"cart_pos": 0.5, "cart_vel": 1.0, "pole_pos": 0.3, "pole_vel": -2.0}
        | {"pendulum_tilt": -0.1, "pendulum_pos": -0.4, "pendulum_vel": 3.0}
    )


@pytest.mark.parametrize("turns", [-2, 1, 3])
def test_a_pendulum_that_has_turned_round_looks_and_pays_as_one_that_has_not(env, turns):
    put(env, 0, (0.0, 0.2, 0.5))
    put(env, 1, (0.0, 0.2, 0.5 + 2 * math.pi * turns))
    assert look(env, 0) == pytest.approx(look(env, 1), abs=1e-5)
    assert pay(env, 0)[0] == pytest.approx(pay(env, 1)[0], abs=1e-5)


def test_a_tilt_of_more_than_half_a_turn_is_the_rest_of_the_turn(env):
    put(env, positions=(0.0, 1.0, 3.0))
    assert look(env)["pendulum_tilt"] == pytest.approx(4.0 - 2 * math.pi)
    assert pay(env)[0] == pytest.approx(2.0 - 1.0 - (4.0 - 2 * math.pi) ** 2, abs=1e-4)


def test_upright_and_still_pays_two(env):
    put(env, positions=(2.0, 0.0, 0.0))
    assert pay(env) == (2.0, False)


def test_tilts_of_both_links_and_speeds_of_all_joints_cost(env):
    put(env, positions=(0.0, 0.3, -0.5), velocities=(2.0, -3.0, 4.0))
    assert pay(env)[0] == pytest.approx(2.0 - 0.09 - 0.04 - 0.01 * 9.0, abs=1e-6)


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
def test_it_fails_where_the_cart_leaves_the_rail_or_the_pole_lies(env, positions, failed):
    put(env, positions=positions)
    reward, ended = pay(env)
    assert ended is failed
    tilts = positions[1] ** 2 + (positions[1] + positions[2]) ** 2
    assert reward == pytest.approx((-4.0 if failed else 2.0) - tilts, abs=1e-5)


def test_a_hanging_pendulum_alone_is_no_failure(env):
    put(env, positions=(0.0, 0.0, math.pi))
    assert pay(env)[1] is False


def test_starts_fill_a_quarter_turn_either_way_and_are_at_rest_in_the_middle():
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


def test_time_truncates_after_five_seconds(env):
    assert env.max_episode_length == 300
    env.episode_length_buf[1] = 299
    put(env, 1)
    result = env.step(torch.zeros(3, 2))
    assert result.truncated.tolist() == [False, True, False]
    assert not result.terminated[1]


@pytest.mark.parametrize(("pendulum", "succeeds"), [(0.05, True), (0.2, False)])
def test_success_is_both_links_upright_to_the_end(pendulum, succeeds):
    env = build(TASK, 1, "episode_length_s=1.0", "success.hold_s=0.5")
    env.reset()
    while True:
        put(env, positions=(0.0, 0.0, pendulum))
        result = env.step(torch.zeros(1, 2))
        if bool(result.truncated[0]):
            break
    assert result.episodes.success.tolist() == [succeeds]


def test_its_terms_compute_what_its_hooks_observe():
    env = build(TASK, 4)
    env.reset()
    terms = env.task.in_terms()
    for action in actions(30, 4, 2):
        env.step(action)
        env.task.get_observations()
        parts = [term_value(env, **term) for term in terms["observations"]]
        torch.testing.assert_close(torch.cat(parts, dim=1), env.task.obs_buf, atol=1e-6, rtol=0)


def term_value(env, func, joints):
    """An observation term of rlcli.mdp on joints by name."""
    robot = env.entities["robot"]
    columns, _ = robot.select("Joints", joints)
    return getattr(observations, func)(env, entity=robot, joints=columns)

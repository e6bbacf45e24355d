"""The task `ball-balance`: model, observations, rewards, terminations, initial states."""

import math

import pytest
import torch
from support.direct_states import observe, reward_and_done
from support.worlds import actions, build

TASK = "ball-balance"
RIGHT_ANGLE = math.pi / 4
"""Links of 0.36 m at 45 degrees, above one another."""


@pytest.fixture
def env():
    env = build(TASK, 3)
    env.reset()
    return env


def put_ball(env, row=0, position=(0.0, 0.0, 0.7), velocity=(0.0, 0.0, 0.0)):
    """Set the ball of one environment; the table stays unchanged."""
    root, dof = env.entities["ball"].floating()
    env.engine.field("qpos")[row, root : root + 3] = torch.tensor(position).double()
    env.engine.field("qvel")[row, dof : dof + 3] = torch.tensor(velocity).double()
    env.sim.refresh()


def hold(env, action, steps):
    """Repeat an action for some steps while the ball is far away."""
    for _ in range(steps):
        for row in range(env.num_envs):
            put_ball(env, row, (0.0, 0.0, 3.0))
        result = env.step(torch.tensor([action] * env.num_envs))
    return result


def height(env, row=0):
    """Return the height of the tray's middle [m]."""
    return float(env.entities["robot"].data.root_pos_w[row, 2])


# --- the model ---


def test_masses_follow_from_sizes_and_densities():
    model, _ = build(TASK, 1).world()
    link = 1000 * (math.pi * 0.02**2 * 0.36 + 4 / 3 * math.pi * 0.02**3)
    assert float(model.body("robot/tray").mass[0]) == pytest.approx(100 * math.pi * 0.5**2 * 0.02)
    assert float(model.body("robot/upper_leg1").mass[0]) == pytest.approx(link, rel=1e-4)
    assert float(model.body("robot/lower_leg2").mass[0]) == pytest.approx(link, rel=1e-4)
    assert float(model.body("ball/ball").mass[0]) == pytest.approx(200 * 4 / 3 * math.pi * 0.1**3)


def test_tray_height_follows_from_links():
    env = build(TASK, 1)
    env.reset()
    assert height(env) == pytest.approx(2 * 0.36 * math.sin(RIGHT_ANGLE) + 0.02 + 0.03, abs=1e-5)


def test_feet_do_not_move_with_table(env):
    model, _ = env.world()
    feet = [model.body(f"robot/lower_leg{leg}").id for leg in (0, 1, 2)]
    for action in actions(60, 3, 3):
        env.step(action.sign())
        _, data = env.world(0)
        for leg, body in enumerate(feet):
            foot = data.xpos[body] + data.xmat[body].reshape(3, 3) @ [0.254558, 0.0, -0.254558]
            angle = 2 * math.pi * leg / 3
            assert foot.tolist() == pytest.approx([0.4 * math.cos(angle), 0.4 * math.sin(angle), 0.02], abs=0.02)
    assert env.divergences == 0


@pytest.mark.slow
def test_random_actions_keep_simulation_stable():
    env = build(TASK, 64, "params.fall_height=-100")
    env.reset()
    for action in actions(600, 64, 3):
        env.step(action.sign())
    assert env.divergences == 0
    tray = env.entities["robot"].data.root_pos_w
    assert float(tray[:, :2].abs().max()) < 0.5
    assert float(tray[:, 2].max()) < 0.9


def test_ball_on_level_table_stays(env):
    put_ball(env, 0, (0.0, 0.0, 0.67))
    for _ in range(100):
        env.step(torch.zeros(3, 3))
    ball = env.entities["ball"].data
    assert ball.root_pos_w[0].tolist() == pytest.approx([0.0, 0.0, height(env) + 0.11], abs=5e-3)
    assert float(ball.root_lin_vel_w[0].abs().max()) < 0.05


# --- actions ---


def test_all_knees_lift_and_lower_table(env):
    begin = height(env)
    for sign in (1.0, -1.0):
        env.reset()
        hold(env, [0.25 * sign] * 3, 4)  # 0.2 rad in all
        hold(env, [0.0] * 3, 60)
        assert sign * (height(env) - begin) > 0.03
        data = env.entities["robot"].data
        assert data.joint_pos[0, 1::2].tolist() == pytest.approx([0.2 * sign] * 3, abs=0.05)
        assert data.projected_gravity_b[0].tolist() == pytest.approx([0.0, 0.0, -1.0], abs=1e-3)


def test_one_knee_tilts_table(env):
    hold(env, [0.25, 0.0, 0.0], 4)
    hold(env, [0.0] * 3, 40)
    down = env.entities["robot"].data.projected_gravity_b[0]
    assert float(down[0]) < -0.02, "the side of leg 0, +x, is the higher one"
    assert abs(float(down[1])) < 2e-3


def test_action_moves_target_within_limits(env):
    env.step(torch.tensor([[1.0, -0.5, 0.0]] * 3))
    assert env.task.targets[0, 1::2].tolist() == pytest.approx([0.2, -0.1, 0.0])
    assert not env.task.targets[:, ::2].any(), "hips have no motor"
    for _ in range(20):
        env.task.pre_physics_step(torch.tensor([[1.0, -1.0, 1.0]] * 3))
    assert env.task.targets[0, 1::2].tolist() == pytest.approx([math.radians(90), math.radians(-70), math.radians(90)])


def test_targets_are_reset(env):
    env.step(torch.full((3, 3), 1.0))
    env.episode_length_buf[1] = env.max_episode_length - 1
    env.step(torch.full((3, 3), 1.0))
    assert not env.task.targets[1].any()
    assert env.task.targets[0, 1::2].tolist() == pytest.approx([0.4] * 3)


# --- observations ---


def test_observation_of_knees_and_ball(env):
    hold(env, [0.5, -0.5, 0.25], 3)
    put_ball(env, 0, (0.1, -0.2, 0.9), (1.0, -2.0, -4.0))
    seen, data = observe(env), env.entities["robot"].data
    assert [seen[f"knee{leg}_pos"] for leg in (0, 1, 2)] == pytest.approx(data.joint_pos[0, 1::2].tolist())
    assert [seen[f"knee{leg}_vel"] for leg in (0, 1, 2)] == pytest.approx(data.joint_vel[0, 1::2].tolist())
    assert seen["knee0_vel"] > 0.1
    assert [seen[f"ball_{axis}"] for axis in "xyz"] == pytest.approx([0.1, -0.2, 0.9])
    assert [seen[f"ball_vel_{axis}"] for axis in "xyz"] == pytest.approx([1.0, -2.0, -4.0])


def test_observations_are_clipped_to_five(env):
    put_ball(env, 0, (0.0, 0.0, 1.5), (0.0, 0.0, -9.0))
    assert float(env.step(torch.zeros(3, 3)).obs["policy"][0, 11]) == -5.0


def test_force_columns_are_sensor_values_per_leg(env):
    hold(env, [0.3, -0.1, 0.2], 5)
    readings = env.entities["robot"].data.sensordata[0].reshape(3, 6)
    seen = observe(env)
    for leg in (0, 1, 2):
        assert seen[f"leg{leg}_force_x"] == pytest.approx(float(readings[leg, 0]) / 20, abs=1e-6)
        for axis in (0, 1, 2):
            assert seen[f"leg{leg}_torque_{'xyz'[axis]}"] == pytest.approx(
                float(readings[leg, 3 + axis]) / 20, abs=1e-6
            )


def test_leg_forces_carry_tray_and_ball(env):
    """The forces on the tray at rest balance its weight; each sensor's frame is its upper leg's."""
    for _ in range(150):
        put_ball(env, 0, (0.0, 0.0, height(env) + 0.1095))
        env.step(torch.zeros(3, 3))
    model, data = env.world(0)
    lifted = 0.0
    for leg in (0, 1, 2):
        force = env.entities["robot"].data.sensordata[0].reshape(3, 6)[leg, :3].double().numpy()
        lifted += (data.site(f"robot/hip{leg}").xmat.reshape(3, 3) @ force)[2]
    weight = 9.81 * float(model.body("robot/tray").mass[0] + model.body("ball/ball").mass[0])
    assert abs(lifted) == pytest.approx(weight, rel=0.1)


def test_new_episode_has_zero_sensors(env):
    for action in actions(5, 3, 3):
        result = env.step(action)
    assert result.obs["policy"][:, 12:].any(dim=1).all()
    env.episode_length_buf[1] = env.max_episode_length - 1
    result = env.step(action)
    assert not result.obs["policy"][1, 12:].any()
    assert result.final_obs["policy"][1, 12:].any()


# --- rewards and ends ---


@pytest.mark.parametrize(
    ("position", "velocity", "reward"),
    [
        ((0.0, 0.0, 0.7), (0.0, 0.0, 0.0), 1.0),
        ((0.3, -0.4, 0.7), (0.0, 0.0, 0.0), 1 / 1.5),
        ((0.0, 0.0, 1.2), (0.0, 0.0, -1.0), 1 / 1.5 / 2),
        ((0.0, 0.3, 0.3), (2.0, 0.0, 0.0), 1 / 1.5 / 3),
    ],
)
def test_reward_of_ball_state(env, position, velocity, reward):
    put_ball(env, 0, position, velocity)
    assert reward_and_done(env) == (pytest.approx(reward, abs=1e-5), False)


@pytest.mark.parametrize(("height", "failed"), [(0.151, False), (0.149, True)])
def test_ball_below_height_terminates(env, height, failed):
    put_ball(env, 0, (0.7, 0.0, height))
    assert reward_and_done(env)[1] is failed


def test_fall_terminates_and_time_out_truncates(env):
    assert env.max_episode_length == 600
    put_ball(env, 1, (0.8, 0.0, 0.16), (0.0, 0.0, -3.0))
    env.episode_length_buf[2] = 599
    result = env.step(torch.zeros(3, 3))
    assert result.terminated.tolist() == [False, True, False]
    assert result.truncated.tolist() == [False, False, True]


# --- starts ---


def test_initial_balls_fall_inwards():
    env = build(TASK, 1000)
    env.reset()
    ball, table = env.entities["ball"].data, env.entities["robot"].data
    position, velocity = ball.root_pos_w, ball.root_lin_vel_w
    distance = torch.linalg.vector_norm(position[:, :2], dim=1)
    assert 0.001 - 1e-6 <= float(distance.min()) < 0.01
    assert 0.39 < float(distance.max()) <= 0.4 + 1e-6
    assert 1.0 <= float(position[:, 2].min()) < 1.02
    assert 1.98 < float(position[:, 2].max()) <= 2.0
    assert velocity[:, 2].tolist() == pytest.approx([-5.0] * 1000)
    assert not ball.root_ang_vel_b.any()
    inwards = -(velocity[:, :2] * position[:, :2]).sum(dim=1) / distance
    across = velocity[:, 0] * position[:, 1] - velocity[:, 1] * position[:, 0]
    assert float(across.abs().max()) < 1e-5
    assert float(inwards.min()) >= 0.0
    assert bool((inwards <= 2.0 * (distance - 0.001) / 0.399 + 1e-5).all())
    assert float((inwards / distance).max()) > 4.5
    assert float(position[:, :2].mean(dim=0).abs().max()) < 0.03, "from all sides alike"
    assert not table.joint_pos.any()
    assert not table.joint_vel.any()


# --- success ---


@pytest.mark.parametrize(("place", "succeeds"), [(0.05, True), (0.2, False)])
def test_success_is_ball_in_middle(place, succeeds):
    env = build(TASK, 1, "episode_length_s=0.6", "success.position.hold_s=0.3")
    env.reset()
    while True:
        put_ball(env, 0, (place, 0.0, 0.67))
        result = env.step(torch.zeros(1, 3))
        if bool(result.truncated[0]):
            break
    assert result.episodes.success.tolist() == [succeeds]

"""The quadruped tasks: model, observations, rewards, terminations, initial states, terrain."""

import math

import pytest
import torch
from support.worlds import build

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task

torch.set_num_threads(1)

LEGS = ("fl", "fr", "bl", "br")
STAND = [0.1, 0.8, -1.5, 0.1, 0.8, -1.5, 0.1, 1.0, -1.5, 0.1, 1.0, -1.5]
CALM = ("events.push=null", "events.payload=null", "events.friction=null", "events.joints=null",
        "observations.policy.enable_corruption=false", "commands.velocity.rel_heading=0.0")  # fmt: skip


def quadruped(task="quadruped-flat", num_envs=2, *overrides):
    env = build(task, num_envs, *CALM, *overrides)
    env.reset()
    return env


def put(env, row, *, position=(0.0, 0.0, 0.34), quat=(1.0, 0.0, 0.0, 0.0), linear=(0, 0, 0), angular=(0, 0, 0),
        joints=STAND, rates=0.0):  # fmt: skip
    """Set the state of one environment; linear velocity in the world frame, angular in the trunk's frame."""
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    values = [*position, *quat, *joints]
    qpos[row] = torch.tensor(values, dtype=torch.float64)
    qvel[row, :6] = torch.tensor([*linear, *angular], dtype=torch.float64)
    qvel[row, 6:] = rates
    env.sim.on_moved(env._select_all())
    env.sim.forward_moved()


def set_command(env, *command):
    """Set the command of all environments."""
    env.command_manager.get_command("velocity")[:] = torch.tensor(command)


def reward_terms(env, row=0):
    """Return the reward terms of the current state, without weights and step time."""
    env.reward_manager.compute(torch.zeros(env.num_envs, dtype=torch.bool))
    weights = {term.name: term.config.weight for term in env.reward_manager.terms}
    values = dict(zip(weights, env.reward_manager.step_terms[:, row].tolist(), strict=True))
    return {name: value / 0.02 / weights[name] for name, value in values.items()}


# --- the model ---


def test_masses_limits_and_gains_equal_go1():
    model = build("quadruped-flat", 1).engine.model
    mass = {
        name: float(model.body(f"robot/{name}").mass[0])
        for name in ("trunk", "hip_fl", "thigh_fl", "shank_fl", "foot_fl")
    }
    assert mass == pytest.approx({"trunk": 5.2, "hip_fl": 0.68, "thigh_fl": 1.009, "shank_fl": 0.14, "foot_fl": 0.056})
    assert float(model.body_mass.sum()) == pytest.approx(5.2 + 4 * (0.68 + 1.009 + 0.196))
    # of the Go1's trunk: 0.0168, 0.0630, 0.0717 kg m^2
    assert sorted(model.body("robot/trunk").inertia) == pytest.approx([0.0150, 0.0614, 0.0659], abs=1e-4)
    low, high = (model.jnt_range[1:, end].reshape(4, 3).tolist() for end in (0, 1))
    assert low == [[-0.863, -0.686, -2.818]] * 4
    assert high == [[0.863, 4.501, -0.888]] * 4
    assert model.actuator_forcerange[:, 1].reshape(4, 3).tolist() == [[23.7, 23.7, 35.55]] * 4
    assert model.actuator_gainprm[:, 0].tolist() == [25.0] * 12
    assert model.actuator_biasprm[:, 2].tolist() == [-0.5] * 12
    assert model.dof_armature[6:].reshape(4, 3).tolist() == [[0.00403, 0.00403, 0.00906]] * 4


def test_foot_positions_follow_joint_angles():
    env = quadruped(num_envs=1)
    put(env, 0)
    sites = env.entities["robot"].data.site_pos_w[0]
    for number, leg in enumerate(LEGS):
        hip, thigh, knee = STAND[3 * number : 3 * number + 3]
        side, end = 1 if leg[1] == "l" else -1, 1 if leg[0] == "f" else -1
        x = 0.1881 * end - 0.213 * (math.sin(thigh) + math.sin(thigh + knee))
        down = 0.213 * (math.cos(thigh) + math.cos(thigh + knee))
        y = side * (0.04675 + 0.08 * math.cos(hip) + down * math.sin(hip))  # a positive hip angle spreads every leg
        z = 0.34 + 0.08 * math.sin(hip) - down * math.cos(hip)
        assert sites[number].tolist() == pytest.approx([x, y, z], abs=1e-5), leg


def test_only_feet_knees_and_trunk_touch_ground():
    model = build("quadruped-flat", 1).engine.model
    names = [model.geom(geom).name.removeprefix("robot/") for geom in range(model.ngeom)]
    solid = {name for name, bits in zip(names, model.geom_conaffinity, strict=True) if bits and name != "ground"}
    assert solid == {
        *(f"trunk_{part}" for part in ("back", "middle", "front")),
        *(f"{part}_{leg}" for part in ("foot", "knee") for leg in LEGS),
    }
    assert not any(bits for name, bits in zip(names, model.geom_contype, strict=True) if name != "ground")


def test_feet_carry_weight():
    env = quadruped(num_envs=2)
    for _ in range(100):
        env.step(torch.zeros(2, 12))
    model, force = env.engine.model, env.sensors["feet"].force
    weight = 9.81 * float(model.body_mass.sum())
    assert force[..., 2].sum(dim=1).tolist() == pytest.approx([weight] * 2, rel=0.02)
    assert (force[..., 2] > 0.15 * weight).all()
    assert (env.entities["robot"].data.root_pos_w[:, 2] > 0.26).all()


def test_action_moves_targets_by_quarter_radian():
    env = quadruped(num_envs=1)
    action = torch.linspace(-1.0, 1.0, 12)
    env.step(action[None])
    targets = env.engine.field("ctrl")[0]
    assert targets.tolist() == pytest.approx((torch.tensor(STAND) + 0.25 * action).tolist(), abs=1e-6)


# --- observations and rewards ---


def test_observation_of_state():
    env = quadruped()
    quat = (math.cos(0.3), math.sin(0.3), 0.0, 0.0)  # rolled by 0.6 rad
    put(env, 1, quat=quat, linear=(0.5, 0.0, 0.0), angular=(0.1, 0.2, 0.3), joints=[q + 0.1 for q in STAND], rates=2.0)
    set_command(env, 0.4, -0.3, 0.2)
    seen = env._compute_observations()["policy"][1].tolist()
    assert len(seen) == 48
    assert seen[0:3] == pytest.approx([0.5, 0.0, 0.0], abs=1e-5)
    assert seen[3:6] == pytest.approx([0.1, 0.2, 0.3], abs=1e-5)
    assert seen[6:9] == pytest.approx([0.0, -math.sin(0.6), -math.cos(0.6)], abs=1e-5)
    assert seen[9:12] == pytest.approx([0.4, -0.3, 0.2])
    assert seen[12:24] == pytest.approx([0.1] * 12, abs=1e-5)
    assert seen[24:36] == pytest.approx([2.0] * 12)
    assert seen[36:48] == [0.0] * 12


def test_rewards_of_state():
    env = quadruped()
    quat = (math.cos(0.1), 0.0, math.sin(0.1), 0.0)  # pitched by 0.2 rad
    put(env, 0, position=(0.0, 0.0, 1.0), quat=quat, angular=(0.2, -0.3, 0.5))
    set_command(env, 0.3, -0.4, 0.0)
    found = reward_terms(env)
    assert found["track_lin_vel"] == pytest.approx(math.exp(-0.25 / 0.25), rel=1e-4)
    assert found["track_ang_vel"] == pytest.approx(math.exp(-0.25 / 0.25), rel=1e-4)
    assert found["ang_vel_xy"] == pytest.approx(0.04 + 0.09, rel=1e-4)
    assert found["flat_orientation"] == pytest.approx(math.sin(0.2) ** 2, rel=1e-4)
    assert found["stand_still"] == 0.0  # the command is to move
    put(env, 0, position=(0.0, 0.0, 1.0), linear=(0.0, 0.0, 0.5), joints=[q + 0.1 for q in STAND])
    set_command(env, 0.0, 0.0, 0.0)
    found = reward_terms(env)
    assert found["lin_vel_z"] == pytest.approx(0.25, rel=1e-4)
    assert found["track_lin_vel"] == pytest.approx(1.0)
    assert found["stand_still"] == pytest.approx(1.2, rel=1e-4)


def test_feet_air_time_reward():
    env = quadruped(num_envs=1)
    feet = env.sensors["feet"]
    set_command(env, 0.5, 0.0, 0.0)
    feet.last_air_time[:] = torch.tensor([[0.45, 0.15, 0.9, 0.9]])
    feet.first_contact[:] = torch.tensor([[True, True, False, False]])
    threshold = env.config.rewards["feet_air_time"].params["threshold"]
    assert reward_terms(env)["feet_air_time"] == pytest.approx(0.45 + 0.15 - 2 * threshold, abs=1e-5)
    set_command(env, 0.0, 0.0, 0.9)
    assert reward_terms(env)["feet_air_time"] == 0.0  # no reward for steps without a command


# --- episodes ---


def test_initial_states_fill_ranges():
    env = build("quadruped-flat", 200)
    env.reset()
    data = env.entities["robot"].data
    place = data.root_pos_w - env.origins
    assert place[:, :2].abs().max() <= 0.5
    assert place[:, :2].std() == pytest.approx(1.0 / math.sqrt(12), rel=0.2)
    assert place[:, 2].tolist() == pytest.approx([0.34] * 200)
    assert (data.joint_pos - torch.tensor(STAND)).abs().max() <= 0.1 + 1e-6
    assert data.heading_w.min() < -2.5 < 2.5 < data.heading_w.max()


def test_trunk_contact_terminates():
    env = quadruped(num_envs=3)
    put(env, 1, position=(0.0, 0.0, 0.05), joints=[0.1, 3.0, -0.9] * 4)  # its legs in the air
    put(env, 2, quat=(0.0, 1.0, 0.0, 0.0), position=(0.0, 0.0, 0.05))  # on its back
    result = env.step(torch.zeros(3, 12))
    assert result.terminated.tolist() == [False, True, True]
    assert not result.truncated.any()


def test_success_requires_tracking_whole_episode():
    """Check that a robot at rest succeeds with a zero command and fails with a velocity command."""
    env = quadruped(
        "quadruped-flat", 2, "episode_length_s=2.0", "success.velocity.hold_s=0.5", "success.yaw_rate.hold_s=0.5"
    )
    for _ in range(100):
        env.command_manager.get_command("velocity")[:] = torch.tensor([[0.0, 0.0, 0.0], [0.8, 0.0, 0.0]])
        result = env.step(torch.zeros(2, 12))
    ended = result.episodes.ended()
    assert ended.truncated.all()
    assert ended.success.tolist() == [True, False]
    assert ended.metrics["velocity/error_vel_xy"][1] == pytest.approx(0.8, abs=0.1)


# --- rough terrain ---


def test_height_scan_of_terrain():
    env = quadruped("quadruped-rough", 1, "scene.terrain.max_start_level=0")
    position = env.origins[0] + torch.tensor([0.3, -0.2, 0.6])
    put(env, 0, position=position.tolist())
    env.sensors["scan"].update(0.02)
    seen = env._compute_observations()["policy"][0]
    assert seen.shape == (48 + 17 * 11,)
    assert seen[48:].tolist() == pytest.approx([0.1] * 187, abs=1e-4)  # 0.6 m above the platform, less 0.5 m
    # a metre further rays reach 1.8 m; stairs of 0.03 m go down from where the platform ends, at 1.6 m
    put(env, 0, position=(env.origins[0] + torch.tensor([1.0, 0.0, 0.6])).tolist())
    env.sensors["scan"].update(0.02)
    rows = env._compute_observations()["policy"][0, 48:].view(11, 17)
    assert rows[:, :15].flatten().tolist() == pytest.approx([0.1] * 165, abs=1e-4)
    assert rows[:, 15:].flatten().tolist() == pytest.approx([0.13] * 22, abs=1e-3)


def test_terrain_levels_rise_with_distance():
    env = quadruped("quadruped-rough", 3, "episode_length_s=0.02")
    env.terrain.levels.fill_(2)
    for row, way in enumerate((4.5, 0.1, 0.0)):
        place = env.origins[row] + torch.tensor([way, 0.0, 0.5])
        put(env, row, position=place.tolist())
    set_command(env, 1.0, 0.0, 0.0)  # half of the way that was asked for is 0.01 m, half a patch 4 m
    env.step(torch.zeros(3, 12))
    assert env.terrain.levels.tolist() == [3, 2, 1]


def test_play_spreads_terrain_levels():
    resolved = resolve(find_task("quadruped-rough"), play=True)
    env = make_env(resolved, seed=1)
    env.reset()
    seen = [env.terrain.levels.clone()]
    for _ in range(3):
        env.reset()
        seen.append(env.terrain.levels.clone())
    levels = torch.stack(seen)
    assert set(levels.flatten().tolist()) == set(range(5))
    assert (levels[1:] != levels[:-1]).any(dim=0).float().mean() > 0.8
    assert not resolved.task.observations["policy"].enable_corruption


@pytest.mark.slow
@pytest.mark.parametrize("task", ["quadruped-flat", "quadruped-rough"])
def test_gpu_engine_stands_like_cpu(task):
    small = ["scene.terrain.rows=2", "scene.terrain.columns=2", "scene.terrain.max_start_level=1"]
    stood = []
    for engine in ("batch", "warp"):
        env = quadruped(task, 4, f"sim.engine={engine}", *(small if task == "quadruped-rough" else []))
        for _ in range(40):
            result = env.step(torch.zeros(4, 12))
            assert not result.terminated.any()
        data = env.entities["robot"].data
        stood.append((data.root_pos_w - env.origins)[:, 2].clone())
        assert (env.sensors["feet"].force[..., 2].sum(dim=1) > 80.0).all()
    assert torch.allclose(*stood, atol=0.02)

"""The tasks `humanoid` and `humanoid-direct`: the model, what is observed and paid, ends, starts, success."""

import math

import mujoco
import pytest
import torch
from support.worlds import actions, build

from rlcli_tasks.humanoid.task import EFFORTS, JOINTS

torch.set_num_threads(1)

POS, RATE = slice(7, 28), slice(6, 27)
"""Columns of qpos and of qvel that are the joints'."""


@pytest.fixture
def env():
    env = build("humanoid-direct", 4)
    env.reset()
    return env


def put(env, row=0, position=(0.0, 0.0, 1.3), quat=(1.0, 0.0, 0.0, 0.0), linear=(0, 0, 0), angular=(0, 0, 0),
        joints=None, rates=0.0):  # fmt: skip
    """Put one environment into a state; angular is in the torso's frame, joints are name -> angle."""
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    qpos[row, :3], qpos[row, 3:7] = torch.tensor(position).double(), torch.tensor(quat).double()
    qvel[row, :3], qvel[row, 3:6] = torch.tensor(linear).double(), torch.tensor(angular).double()
    qpos[row, POS], qvel[row, RATE] = 0.0, rates
    for name, angle in (joints or {}).items():
        qpos[row, 7 + JOINTS.index(name)] = angle
    env.sim.refresh()
    env.task.position_before[row] = torch.tensor(position[:2])
    env.task.distance_before[row] = math.hypot(1000.0 - position[0], position[1])


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


def posed(**joints):
    """A world of the model alone with joints at some angles, in the air."""
    model, data = build("humanoid-direct", 1).world()
    data.qpos[:] = 0.0
    data.qpos[2:4] = 1.34, 1.0
    for name, angle in joints.items():
        data.joint(f"robot/{name}").qpos = angle
    mujoco.mj_forward(model, data)
    return model, data


# --- the model ---


def test_the_model_has_the_mass_the_joints_and_the_motors_of_its_source():
    model, _ = posed()
    assert float(model.body_mass.sum()) == pytest.approx(40.844, abs=1e-3)
    names = [model.joint(i).name.removeprefix("robot/") for i in range(1, model.njnt)]
    assert tuple(names) == JOINTS
    assert model.actuator_gear[:, 0].tolist() == list(EFFORTS.values())
    assert sum(EFFORTS.values()) == 3 * 67.5 + 2 * (45 + 45 + 135 + 90 + 22.5 + 22.5) + 2 * (67.5 + 67.5 + 45)
    degrees = {name: model.joint(f"robot/{name}").range * 180 / math.pi for name in names}
    assert degrees["knee_l"].tolist() == pytest.approx([-2, 160])
    assert degrees["hip_pitch_r"].tolist() == pytest.approx([-45, 120])
    assert degrees["waist_pitch"].tolist() == pytest.approx([-75, 30])


@pytest.mark.parametrize("joint", ["hip_roll", "hip_yaw", "hip_pitch", "knee", "ankle_pitch", "ankle_roll",
                                   "shoulder_1", "shoulder_2", "elbow"])  # fmt: skip
def test_left_and_right_are_mirror_images_in_every_pose(joint):
    _, left = posed(**{f"{joint}_l": 0.4})
    _, right = posed(**{f"{joint}_r": 0.4})
    moved = 0
    for name in ("sole_in", "sole_out", "shin", "thigh", "upper_arm", "forearm", "hand"):
        x, y, z = left.geom(f"robot/{name}_l").xpos
        assert right.geom(f"robot/{name}_r").xpos == pytest.approx([x, -y, z], abs=1e-9)
        moved += abs(right.geom(f"robot/{name}_l").xpos - left.geom(f"robot/{name}_l").xpos).max() > 1e-3
    assert moved >= 1


def test_positive_angles_bend_hips_and_knees_and_swing_legs_inwards():
    _, rest = posed()
    for side, inwards in (("l", -1.0), ("r", 1.0)):
        foot = f"robot/foot_{side}"
        _, hip = posed(**{f"hip_pitch_{side}": 0.5})
        _, knee = posed(**{f"knee_{side}": 0.5})
        _, roll = posed(**{f"hip_roll_{side}": 0.2})
        assert hip.body(foot).xpos[0] > rest.body(foot).xpos[0] + 0.3
        assert knee.body(foot).xpos[0] < rest.body(foot).xpos[0] - 0.1
        assert (roll.body(foot).xpos[1] - rest.body(foot).xpos[1]) * inwards > 0.1


def test_legs_touch_each_other_and_the_ground_and_arms_nothing():
    model, crossed = posed(hip_roll_l=0.24, hip_roll_r=0.24)
    pairs = {tuple(sorted(model.geom(g).name.removeprefix("robot/") for g in c.geom)) for c in crossed.contact}
    assert pairs
    assert all({name[-1] for name in pair} == {"l", "r"} for pair in pairs)
    model, folded = posed(shoulder_1_l=-1.2, elbow_l=-1.5, shoulder_1_r=-1.2, elbow_r=-1.5)
    assert folded.ncon == 0


def test_no_start_pose_reaches_into_the_ground_or_one_leg_into_the_other():
    env = build("humanoid-direct", 300)
    env.reset()
    model, data = env.world()
    qpos = env.engine.field("qpos").numpy()
    for row in range(300):
        data.qpos[:] = qpos[row]
        mujoco.mj_forward(model, data)
        assert data.ncon == 0 or data.contact.dist.min() > -5e-3


@pytest.mark.parametrize(("num_envs", "steps"), [(16, 150), pytest.param(100, 1000, marks=pytest.mark.slow)])
def test_full_random_torques_never_blow_the_simulation_up(num_envs, steps):
    env = build("humanoid-direct", num_envs, "params.termination_height=-10", "episode_length_s=1000")
    env.reset()
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    generator = torch.Generator().manual_seed(0)
    fastest = highest = 0.0
    for _ in range(steps):
        env.step((torch.rand(num_envs, 21, generator=generator) * 2 - 1).sign())
        fastest = max(fastest, float(qvel[:, RATE].abs().max()))
        highest = max(highest, float(qpos[:, 2].max()))
    assert env.divergences == 0
    assert 20.0 < fastest < 150.0
    assert highest < 1.6
    assert float(qpos[:, 2].min()) > 0.0, "the trunk lies on the ground"


# --- observations ---


def test_the_columns_are_those_of_the_state_scaled(env):
    joints = {"knee_l": math.radians(160), "hip_pitch_r": math.radians(-45), "waist_yaw": math.radians(22.5)}
    put(env, position=(3, 4, 1.2), linear=(3, -2, 1), angular=(0.5, -0.25, 2), joints=joints, rates=2.0)
    seen = look(env)
    assert [seen[n] for n in ("height", "vel_x", "vel_y", "vel_z")] == pytest.approx([1.2, 3, -2, 1])
    assert [seen[n] for n in ("rate_x", "rate_y", "rate_z")] == pytest.approx([0.125, -0.0625, 0.5])
    assert [seen["knee_l_pos"], seen["hip_pitch_r_pos"], seen["waist_yaw_pos"]] == pytest.approx([1, -1, 0.5])
    assert seen["knee_r_pos"] == pytest.approx((0 - 79) / 81, abs=1e-6)
    assert [seen[f"{joint}_vel"] for joint in JOINTS] == pytest.approx([0.2] * 21)
    assert len(seen) == 87


def test_feet_carry_what_stands_on_them_when_they_do(env):
    """Right after landing the ankles push up with about the weight; in free fall they push not at all."""
    for row in range(4):
        put(env, row, position=(0.0, 0.0, 1.289))  # soles on the ground
    total, steps = 0.0, 12
    for _ in range(steps):
        obs = env.step(torch.zeros(4, 21)).obs["policy"][0]
        total += float(obs[54 + 2] + obs[60 + 2]) * 100.0 / steps
    assert abs(total) == pytest.approx((40.844 - 2 * 1.135) * 9.81, rel=0.25)
    for row in range(4):
        put(env, row, position=(0.0, 0.0, 3.0))
    obs = env.step(torch.zeros(4, 21)).obs["policy"][0]
    assert abs(float(obs[54 + 2] + obs[60 + 2])) * 100.0 < 30.0


def test_a_new_episode_has_felt_nothing_and_done_nothing_yet(env):
    for action in actions(30, 4, 21):
        result = env.step(action * 0.3)
    env.episode_length_buf[2] = env.max_episode_length - 1
    result = env.step(action * 0.3)
    assert bool(result.truncated[2])
    assert not result.obs["policy"][2, 54:].any()
    assert result.final_obs["policy"][2, 54:].any()


# --- rewards and ends ---


def test_standing_still_pays_for_life_posture_and_heading(env):
    put(env)
    assert pay(env) == (pytest.approx(2.0 + 0.1 + 0.5), False)


def test_progress_is_the_speed_towards_the_target(env):
    put(env)
    env.engine.field("qpos")[0, :2] = torch.tensor([0.05, 0.02], dtype=torch.float64)
    env.sim.refresh()
    assert pay(env)[0] == pytest.approx(2.6 + 0.05 * 60, abs=1e-4)
    assert float(env.task.speed[0]) == pytest.approx(3.0, abs=1e-4)


def test_actions_and_power_cost_and_power_counts_by_the_strength_of_the_motor(env):
    rates = torch.zeros(21, dtype=torch.float64)
    rates[JOINTS.index("hip_pitch_l")], rates[JOINTS.index("ankle_roll_r")] = 3.0, -6.0
    put(env, rates=rates)
    env.task.actions[0, JOINTS.index("hip_pitch_l")] = -0.5
    env.task.actions[0, JOINTS.index("ankle_roll_r")] = 0.8
    squares, power = 0.25 + 0.64, 0.5 * 0.3 * 1.0 + 0.8 * 0.6 * 22.5 / 135
    assert pay(env)[0] == pytest.approx(2.6 - 0.01 * squares - 0.05 * power, abs=1e-5)


def test_a_joint_near_a_limit_costs_by_how_near_and_how_strong_it_is(env):
    half = math.radians(50)
    put(env, joints={"ankle_roll_l": 0.99 * half, "ankle_pitch_l": -0.97 * half, "hip_pitch_r": math.radians(120)})
    assert pay(env)[0] == pytest.approx(2.6 - 0.25 * (0.5 * 22.5 / 135 + 1.0), abs=1e-4)


def test_who_is_below_the_height_has_fallen_and_gets_that_reward_alone(env):
    put(env, position=(0.0, 0.0, 0.7999), linear=(5.0, 0.0, 0.0))
    assert pay(env) == (-1.0, True)
    put(env, position=(0.0, 0.0, 0.8001), linear=(5.0, 0.0, 0.0))
    assert pay(env)[1] is False


def test_torques_are_the_motors_times_the_action(env):
    env.step(torch.full((4, 21), -0.4))
    torque = env.engine.field("qfrc_actuator")[0, RATE]
    assert torque.tolist() == pytest.approx([-0.4 * effort for effort in EFFORTS.values()], rel=1e-5)


# --- starts ---


def test_starts_are_drawn_within_the_limits_and_nothing_else_differs():
    env = build("humanoid-direct", 500)
    env.reset()
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    assert torch.equal(qpos[:, :7], torch.tensor([0, 0, 1.34, 1, 0, 0, 0], dtype=torch.float64).expand(500, 7))
    assert not qvel[:, :6].any()
    low, high = env.entities["robot"].data.joint_pos_limits.double().unbind(dim=1)
    joints = qpos[:, POS]
    assert ((joints >= low - 1e-6) & (joints <= high + 1e-6)).all()
    top = torch.full((21,), 0.2, dtype=torch.float64)
    top[[JOINTS.index("hip_roll_l"), JOINTS.index("hip_roll_r")]] = 0.0
    assert ((joints.amax(dim=0) - top).abs() < 0.01).all()
    bound = torch.maximum(torch.full((21,), -0.2, dtype=torch.float64), low)
    assert ((joints.amin(dim=0) - bound).abs() < 0.01).all()
    rates = qvel[:, RATE].abs()
    assert float(rates.max()) <= 0.1
    assert (rates.amax(dim=0) > 0.095).all()


# --- success ---


@pytest.mark.parametrize("task", ["humanoid", "humanoid-direct"])
@pytest.mark.parametrize(("speed", "pitch", "succeeds"), [(2.0, 0.0, True), (0.9, 0.0, False), (2.0, 1.0, False)])
def test_an_episode_that_ends_upright_and_at_speed_is_a_success(task, speed, pitch, succeeds):
    env = build(task, 2, "episode_length_s=0.5", "success.hold_s=0.3")
    env.reset()
    tilted = torch.tensor([math.cos(pitch / 2), 0.0, math.sin(pitch / 2), 0.0]).double()
    for _ in range(30):
        env.engine.field("qvel")[:] = 0.0
        env.engine.field("qvel")[:, 0] = speed
        env.engine.field("qpos")[:, 2] = 1.5
        env.engine.field("qpos")[:, 3:7] = tilted
        result = env.step(torch.zeros(2, 21))
    assert result.truncated.all()
    assert result.episodes.success.tolist() == [succeeds] * 2

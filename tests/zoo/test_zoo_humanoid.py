"""The tasks `humanoid` and `humanoid-direct`: model, observations, rewards, initial states, success."""

import math

import mujoco
import pytest
import torch
from support.direct_states import observe, reward_and_done, set_floating_state
from support.worlds import build

from rlcli_tasks.humanoid.task import EFFORTS, JOINTS

torch.set_num_threads(1)

POS, RATE = slice(7, 28), slice(6, 27)
"""Columns of the joints in qpos and in qvel."""


@pytest.fixture
def env():
    env = build("humanoid-direct", 4)
    env.reset()
    return env


def put(env, row=0, position=(0.0, 0.0, 1.3), quat=(1.0, 0.0, 0.0, 0.0), linear=(0, 0, 0), angular=(0, 0, 0),
        joints=None, rates=0.0):  # fmt: skip
    """Set the state of one environment; angular velocity is in the torso's frame, joints are name -> angle [rad]."""
    angles = torch.zeros(len(JOINTS), dtype=torch.float64)
    for name, angle in (joints or {}).items():
        angles[JOINTS.index(name)] = angle
    set_floating_state(env, row, position, quat, linear, angular, angles, rates)
    env.task.position_before[row] = torch.tensor(position[:2])
    env.task.distance_before[row] = math.hypot(1000.0 - position[0], position[1])


def posed(**joints):
    """Return the compiled model and its data, in the air with joints at the given angles [rad]."""
    model, data = build("humanoid-direct", 1).world()
    data.qpos[:] = 0.0
    data.qpos[2:4] = 1.34, 1.0
    for name, angle in joints.items():
        data.joint(f"robot/{name}").qpos = angle
    mujoco.mj_forward(model, data)
    return model, data


# --- the model ---


def test_model_has_mass_joints_and_motors_of_source():
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
def test_left_and_right_are_mirrored(joint):
    _, left = posed(**{f"{joint}_l": 0.4})
    _, right = posed(**{f"{joint}_r": 0.4})
    moved = 0
    for name in ("sole_in", "sole_out", "shin", "thigh", "upper_arm", "forearm", "hand"):
        x, y, z = left.geom(f"robot/{name}_l").xpos
        assert right.geom(f"robot/{name}_r").xpos == pytest.approx([x, -y, z], abs=1e-9)
        moved += abs(right.geom(f"robot/{name}_l").xpos - left.geom(f"robot/{name}_l").xpos).max() > 1e-3
    assert moved >= 1


def test_direction_of_positive_joint_angles():
    _, rest = posed()
    for side, inwards in (("l", -1.0), ("r", 1.0)):
        foot = f"robot/foot_{side}"
        _, hip = posed(**{f"hip_pitch_{side}": 0.5})
        _, knee = posed(**{f"knee_{side}": 0.5})
        _, roll = posed(**{f"hip_roll_{side}": 0.2})
        assert hip.body(foot).xpos[0] > rest.body(foot).xpos[0] + 0.3
        assert knee.body(foot).xpos[0] < rest.body(foot).xpos[0] - 0.1
        assert (roll.body(foot).xpos[1] - rest.body(foot).xpos[1]) * inwards > 0.1


def test_legs_collide_and_arms_do_not():
    model, crossed = posed(hip_roll_l=0.24, hip_roll_r=0.24)
    pairs = {tuple(sorted(model.geom(g).name.removeprefix("robot/") for g in c.geom)) for c in crossed.contact}
    assert pairs
    assert all({name[-1] for name in pair} == {"l", "r"} for pair in pairs)
    model, folded = posed(shoulder_1_l=-1.2, elbow_l=-1.5, shoulder_1_r=-1.2, elbow_r=-1.5)
    assert folded.ncon == 0


def test_initial_poses_have_no_penetration():
    env = build("humanoid-direct", 300)
    env.reset()
    model, data = env.world()
    qpos = env.engine.field("qpos").numpy()
    for row in range(300):
        data.qpos[:] = qpos[row]
        mujoco.mj_forward(model, data)
        assert data.ncon == 0 or data.contact.dist.min() > -5e-3


# --- observations ---


def test_observation_is_scaled_state(env):
    joints = {"knee_l": math.radians(160), "hip_pitch_r": math.radians(-45), "waist_yaw": math.radians(22.5)}
    put(env, position=(3, 4, 1.2), linear=(3, -2, 1), angular=(0.5, -0.25, 2), joints=joints, rates=2.0)
    seen = observe(env)
    assert [seen[n] for n in ("height", "vel_x", "vel_y", "vel_z")] == pytest.approx([1.2, 3, -2, 1])
    assert [seen[n] for n in ("rate_x", "rate_y", "rate_z")] == pytest.approx([0.125, -0.0625, 0.5])
    assert [seen["knee_l_pos"], seen["hip_pitch_r_pos"], seen["waist_yaw_pos"]] == pytest.approx([1, -1, 0.5])
    assert seen["knee_r_pos"] == pytest.approx((0 - 79) / 81, abs=1e-6)
    assert [seen[f"{joint}_vel"] for joint in JOINTS] == pytest.approx([0.2] * 21)
    assert len(seen) == 87


def test_foot_forces_carry_weight_on_ground_only(env):
    """Check the ankle forces: about the weight after landing, about 0 in free fall."""
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


# --- rewards ---


def test_action_and_power_costs_scale_with_motor(env):
    rates = torch.zeros(21, dtype=torch.float64)
    rates[JOINTS.index("hip_pitch_l")], rates[JOINTS.index("ankle_roll_r")] = 3.0, -6.0
    put(env, rates=rates)
    env.task.actions[0, JOINTS.index("hip_pitch_l")] = -0.5
    env.task.actions[0, JOINTS.index("ankle_roll_r")] = 0.8
    squares, power = 0.25 + 0.64, 0.5 * 0.3 * 1.0 + 0.8 * 0.6 * 22.5 / 135
    assert reward_and_done(env)[0] == pytest.approx(2.6 - 0.01 * squares - 0.05 * power, abs=1e-5)


def test_joint_limit_cost_scales_with_motor(env):
    half = math.radians(50)
    put(env, joints={"ankle_roll_l": 0.99 * half, "ankle_pitch_l": -0.97 * half, "hip_pitch_r": math.radians(120)})
    assert reward_and_done(env)[0] == pytest.approx(2.6 - 0.25 * (0.5 * 22.5 / 135 + 1.0), abs=1e-4)


def test_torque_is_motor_gear_times_action(env):
    env.step(torch.full((4, 21), -0.4))
    torque = env.engine.field("qfrc_actuator")[0, RATE]
    assert torque.tolist() == pytest.approx([-0.4 * effort for effort in EFFORTS.values()], rel=1e-5)


# --- initial states ---


def test_initial_states_are_within_limits():
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
def test_success_requires_upright_and_speed_at_end(task, speed, pitch, succeeds):
    env = build(task, 2, "episode_length_s=0.5", "success.velocity.hold_s=0.3", "success.upright.hold_s=0.3")
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

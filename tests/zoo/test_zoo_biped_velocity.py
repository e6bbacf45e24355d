"""The task `biped-velocity`: servos, commands, observations, rewards, terminations, success."""

import math

import pytest
import torch
from support.worlds import build

from rlcli_tasks.humanoid.task import EFFORTS, JOINTS

torch.set_num_threads(1)

CALM = (
    "observations.policy.enable_corruption=false",
    "commands.walk.rel_heading=0.0",
    "commands.walk.rel_standing=0.0",
)
REST = {"hip_pitch_l": 0.3, "hip_pitch_r": 0.3, "knee_l": 0.6, "knee_r": 0.6, "ankle_pitch_l": -0.3,
        "ankle_pitch_r": -0.3}  # fmt: skip
POSE = torch.tensor([REST.get(name, 0.0) for name in JOINTS], dtype=torch.float64)


def biped(num_envs=2, *overrides):
    env = build("biped-velocity", num_envs, *CALM, *overrides)
    env.reset()
    return env


def put(env, row, *, height=1.26, quat=(1.0, 0.0, 0.0, 0.0), linear=(0, 0, 0), angular=(0, 0, 0), joints=POSE,
        rates=0.0):  # fmt: skip
    """Set the state of one environment; linear velocity in the world frame, angular in the torso's frame."""
    qpos, qvel = env.engine.field("qpos"), env.engine.field("qvel")
    qpos[row] = torch.cat([torch.tensor([0.0, 0.0, height, *quat], dtype=torch.float64), joints])
    qvel[row, :6] = torch.tensor([*linear, *angular], dtype=torch.float64)
    qvel[row, 6:] = rates
    env.sim.on_moved(env._select_all())
    env.sim.forward_moved()


def set_command(env, *command):
    env.command_manager.get_command("walk")[:] = torch.tensor(command)


def reward_terms(env, row=0):
    """Return the reward terms of the current state, without weights and step time."""
    env.reward_manager.compute()
    return {
        term.name: float(value) / 0.02 / term.config.weight
        for term, value in zip(env.reward_manager.terms, env.reward_manager.step_terms[:, row], strict=True)
    }


def test_joints_are_servos_with_humanoid_torque():
    env = biped(1)
    model = env.engine.model
    position = [model.actuator(i) for i in range(model.nu) if model.actuator_biastype[i] == 1]
    assert len(position) == 21
    assert [float(a.forcerange[1]) for a in position] == list(EFFORTS.values())
    assert not model.jnt_stiffness.any()
    action = torch.linspace(-1.0, 1.0, 21)[None]
    env.step(action)
    targets = torch.stack([env.engine.field("ctrl")[0, a.id] for a in position])
    torch.testing.assert_close(targets, POSE + 0.5 * action[0].double(), rtol=0, atol=1e-6)


def test_initial_pose_has_level_soles_above_ground():
    env = biped(8)
    model, data = env.world(0)
    assert data.ncon == 0
    for name in ("sole_in_l", "sole_out_l", "sole_in_r", "sole_out_r"):
        geom = data.geom(f"robot/{name}")
        along = geom.xmat.reshape(3, 3)[2, 2] * model.geom(f"robot/{name}").size[1]
        lowest = geom.xpos[2] - abs(along) - 0.027
        assert 0.0 < lowest < 0.01, name
        assert abs(along) < 1e-6, "level"
    yaws = env.engine.field("qpos")[:, 3]
    assert float(yaws.std()) > 0.1, "facing anywhere"
    torch.testing.assert_close(env.engine.field("qpos")[:, 7:], POSE.expand(8, 21))
    for _ in range(10):
        env.step(torch.zeros(8, 21))
    weight = 9.81 * float(model.body_mass.sum())
    assert env.sensors["feet"].force[..., 2].sum(dim=1).tolist() == pytest.approx([weight] * 8, rel=0.15)


def test_commands_fill_ranges():
    env = build("biped-velocity", 2000, "commands.walk.rel_heading=0.0")
    env.reset()
    asked = env.command_manager.get_command("walk")
    stands = ~asked.any(dim=1)
    assert 0.005 < float(stands.float().mean()) < 0.05
    low, high = torch.tensor([0.0, -0.5, -1.0]), torch.tensor([1.0, 0.5, 1.0])
    moving = asked[~stands]
    assert ((moving >= low) & (moving <= high)).all()
    assert (moving.amin(dim=0) < low + 0.02).all()
    assert (moving.amax(dim=0) > high - 0.02).all()


def test_observation_of_state():
    env = biped()
    quat = (math.cos(0.2), math.sin(0.2), 0.0, 0.0)  # rolled by 0.4 rad
    put(env, 1, quat=quat, linear=(0.5, 0.0, 0.2), angular=(0.1, 0.2, 0.3), joints=POSE + 0.05, rates=0.5)
    set_command(env, 0.4, -0.3, 0.2)
    seen = env._compute_observations()["policy"][1].tolist()
    assert seen[:3] == pytest.approx([0.5, 0.2 * math.sin(0.4), 0.2 * math.cos(0.4)], abs=1e-5)
    assert seen[3:6] == pytest.approx([0.1, 0.2, 0.3], abs=1e-5)
    assert seen[6:9] == pytest.approx([0.0, -math.sin(0.4), -math.cos(0.4)], abs=1e-5)
    assert seen[9:12] == pytest.approx([0.4, -0.3, 0.2])
    assert seen[12:33] == pytest.approx([0.05] * 21, abs=1e-6)
    assert seen[33:54] == pytest.approx([0.5] * 21, abs=1e-6)
    assert seen[54:] == [0.0] * 21


def test_tracking_reward_uses_heading_frame():
    env = biped()
    put(env, 0, linear=(0.6, 0.1, 0.3), angular=(0.0, 0.0, 0.4))
    set_command(env, 0.8, 0.0, 0.1)
    terms = reward_terms(env)
    assert terms["track_lin_vel"] == pytest.approx(math.exp(-(0.2**2 + 0.1**2) / 0.25), abs=1e-5)
    assert terms["track_ang_vel"] == pytest.approx(math.exp(-(0.3**2) / 0.25), abs=1e-5)
    assert terms["tilt"] == pytest.approx(0.0, abs=1e-6)


def test_posture_cost_of_joint_deviation():
    env = biped()
    joints = POSE.clone()
    for name, off in {"hip_yaw_l": 0.2, "hip_pitch_l": 0.3, "shoulder_1_r": -0.4, "waist_roll": 0.1}.items():
        joints[JOINTS.index(name)] += off
    put(env, 0, joints=joints)
    terms = reward_terms(env)
    assert [terms[n] for n in ("hips", "arms", "waist")] == pytest.approx([0.2, 0.4, 0.1], abs=1e-5)
    limit = math.radians(50) * 0.9
    joints[JOINTS.index("ankle_roll_r")] = limit + 0.05
    put(env, 0, joints=joints)
    assert reward_terms(env)["ankle_limits"] == pytest.approx(0.05, abs=1e-4)


@pytest.mark.parametrize(("height", "roll", "cause"), [(0.79, 0.0, "low"), (1.5, 1.01, "tilted"), (0.9, 0.9, None)])
def test_low_or_tilted_torso_terminates(height, roll, cause):
    env = biped(2)
    put(env, 0, height=height, quat=(math.cos(roll / 2), math.sin(roll / 2), 0.0, 0.0))
    env.termination_manager.compute(None)
    assert [name for name, fired in env.termination_manager.fired.items() if fired[0]] == ([cause] if cause else [])


@pytest.mark.parametrize(("speed", "succeeds"), [(0.5, True), (0.75, True), (0.85, False)])
def test_success_requires_commanded_velocity(speed, succeeds):
    env = biped(2, "episode_length_s=0.4", "success.velocity.hold_s=0.2", "success.yaw_rate.hold_s=0.2",
                "commands.walk.lin_vel_x=[0.5,0.5]", "commands.walk.lin_vel_y=[0.0,0.0]",
                "commands.walk.ang_vel_z=[0.0,0.0]", "events.base.yaw=[0.0,0.0]",
                "sim.gravity=[0.0,0.0,0.0]")  # fmt: skip
    for _ in range(20):
        for row in range(2):
            put(env, row, height=1.5, linear=(speed, 0.0, 0.0))
        result = env.step(torch.zeros(2, 21))
    assert result.truncated.all()
    assert result.episodes.success.tolist() == [succeeds] * 2

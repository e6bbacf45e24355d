"""Events on hand-made states, and terms with a memory."""

from math import acos, cos, pi, sin, sqrt

import numpy as np
import pytest
import torch
from support.worlds import CRITTER_TASK, build, critter, edited

from rlcli.errors import TaskError
from rlcli.mdp import events, rewards, terminations
from rlcli.sim.env_selection import IdSelection

LIMIT = pi / 3


@pytest.mark.parametrize("turns", [-3, -1, 0, 1, 2])
@pytest.mark.parametrize("angle", [0.0, 0.4, -0.4, pi])
def test_joint_pos_target_l2_wraps_whole_turns(turns, angle):
    from rlcli.sim.rotations import wrap_to_pi

    wrapped = float(wrap_to_pi(torch.tensor([angle + 2 * pi * turns]))[0])
    assert min(abs(wrapped - angle), abs(wrapped + 2 * pi - angle)) < 2e-6
    assert -pi - 1e-6 < wrapped <= pi + 1e-6


def test_bad_orientation_finds_robot_on_its_back(tmp_path):
    env = build(critter(tmp_path), 2)
    env.reset()
    robot = env.entities["robot"]
    env.engine.field("qpos")[1, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    env.sim.refresh()
    assert bool(terminations.bad_orientation(env, entity=robot, limit_angle=acos(-0.999))[1])
    assert robot.data.projected_gravity_b[1].tolist() == pytest.approx([0, 0, 1])


def test_acceleration_and_torque_are_of_last_substep(tmp_path):
    env = build(critter(tmp_path), 2)
    env.reset()
    action = torch.tensor([[0.1, 0.2, -0.3, 0.4]] * 2)
    env.step(action)
    robot = env.entities["robot"]
    joints = robot.select("Joints", ["hip_br", "hip_fl"])[0]
    qacc = env.engine.field("qacc")[:, [9, 6]]
    effort = env.engine.field("qfrc_actuator")[:, [9, 6]]
    assert qacc.abs().min() > 0
    assert effort.abs().min() > 0
    acc = rewards.joint_acc_l2(env, entity=robot, joints=joints)
    torque = rewards.joint_torques_l2(env, entity=robot, joints=joints)
    assert acc.tolist() == pytest.approx(qacc.square().sum(dim=1).tolist(), rel=1e-5)
    assert torque.tolist() == pytest.approx(effort.square().sum(dim=1).tolist(), rel=1e-5)
    assert float(env.engine.field("qfrc_actuator")[:, 6:].abs().max()) <= 8.0 + 1e-9, "under its limit"


def test_progress_reward_is_speed_to_target(tmp_path):
    start = {
        "func": "reset_root_state_uniform",
        "mode": "reset",
        "x": [-5.0, 5.0],
        "linear_velocity": [[2.0, 2.0], [0.0, 0.0], [0.0, 0.0]],
    }
    task = edited(
        CRITTER_TASK,
        sim={"gravity": [0.0, 0.0, 0.0]},
        scene={"ground": None},
        events={"joints": None, "push": None, "shove": None, "root": start},
        terminations={"tilt": None, "low": None},
    )
    env = build(critter(tmp_path, task), 3)
    env.reset()
    term = next(t for t in env.reward_manager.terms if t.name == "progress")
    for step in range(65):  # two time-outs within the run
        start = env.engine.field("qpos")[:, 0].clone()
        result = env.step(torch.zeros(3, 4))
        position = env.entities["robot"].data.root_pos_w[:, 0]
        if result.truncated.any():
            continue
        speed = env.reward_manager._values[env.reward_manager.terms.index(term)] / env.step_dt
        assert speed.tolist() == pytest.approx(((position - start) / env.step_dt).tolist(), rel=0.02), step
        assert speed.min() > 1.0


def some(env, *ids):
    ids = np.array(ids)
    return IdSelection(ids, 0, np.zeros_like(ids))


@pytest.fixture
def fresh(tmp_path):
    env = build(critter(tmp_path), 3)
    env.reset()
    return env


def joints_of(env, names):
    return env.entities["robot"].select("Joints", names)[0]


def test_reset_joints_by_offset_clips_to_limits(fresh):
    before = fresh.engine.field("qpos").clone()
    robot, joints = fresh.entities["robot"], joints_of(fresh, ["hip_br", "hip_fl"])
    events.reset_joints_by_offset(
        fresh, some(fresh, 1), entity=robot, joints=joints, position=(0.2, 0.2), velocity=(-3.0, -3.0)
    )
    qpos, qvel = fresh.engine.field("qpos"), fresh.engine.field("qvel")
    assert float(qpos[1, 7]) == pytest.approx(0.1 + 0.2)
    assert float(qpos[1, 10]) == pytest.approx(-0.1 + 0.2)
    assert torch.equal(qpos[1, 8:10], before[1, 8:10]), "joints not named"
    assert torch.equal(qpos[[0, 2]], before[[0, 2]]), "environments not selected"
    assert qvel[1, [6, 9]].tolist() == [-3.0, -3.0]
    events.reset_joints_by_offset(fresh, some(fresh, 1), entity=robot, joints=joints, position=(9.0, 9.0))
    assert qpos[1, [7, 10]].tolist() == pytest.approx([LIMIT, LIMIT])


def test_reset_joints_by_scale_multiplies_default(fresh):
    robot = fresh.entities["robot"]
    events.reset_joints_by_scale(
        fresh, some(fresh, 2), entity=robot, joints=slice(0, 4), position=(2.0, 2.0), velocity=(0.0, 0.0)
    )
    assert fresh.engine.field("qpos")[2, 7:].tolist() == pytest.approx([0.2, -0.2, 0.2, -0.2])
    assert not fresh.engine.field("qvel")[2, 6:].any()


def test_reset_root_state_sets_pose_and_velocity(fresh):
    zero = (0.0, 0.0)
    events.reset_root_state_uniform(
        fresh, some(fresh, 1), entity=fresh.entities["robot"],
        x=(1.0, 1.0), y=(2.0, 2.0), z=(0.1, 0.1), yaw=(pi / 2, pi / 2),
        linear_velocity=[(1.0, 1.0), zero, zero], angular_velocity=[(0.5, 0.5), zero, zero],
    )  # fmt: skip
    half = sqrt(0.5)
    assert fresh.engine.field("qpos")[1, :7].tolist() == pytest.approx([1, 2, 0.45, half, 0, 0, half], abs=1e-6)
    # with a yaw of 90 degrees the world's x is the body's -y; rates of a free joint are in the body frame
    assert fresh.engine.field("qvel")[1, :6].tolist() == pytest.approx([1, 0, 0, 0, -0.5, 0], abs=1e-6)


@pytest.mark.parametrize(("axis", "turned"), [("roll", [0, sin(0.4), 0, 0]), ("pitch", [0, 0, sin(0.4), 0]),
                                              ("yaw", [0, 0, 0, sin(0.4)])])  # fmt: skip
def test_reset_root_state_turns_about_roll_pitch_yaw_axes(fresh, axis, turned):
    events.reset_root_state_uniform(fresh, some(fresh, 0), entity=fresh.entities["robot"], **{axis: (0.8, 0.8)})
    expected = [cos(0.4), *turned[1:]]
    assert fresh.engine.field("qpos")[0, 3:7].tolist() == pytest.approx(expected, abs=1e-6)


def test_uniform_resets_fill_their_ranges(tmp_path):
    env = build(critter(tmp_path), 512)
    env.reset()
    qpos = env.engine.field("qpos")
    assert -0.5 <= float(qpos[:, 0].min()) < -0.47
    assert 0.47 < float(qpos[:, 0].max()) <= 0.5
    assert 0.35 <= float(qpos[:, 2].min()) < float(qpos[:, 2].max()) <= 0.4 + 1e-6
    assert abs(float(np.corrcoef(qpos[:, 0], qpos[:, 1])[0, 1])) < 0.2
    assert (qpos[:, 3:7].norm(dim=1) - 1).abs().max() < 1e-6


def test_push_adds_to_world_frame_velocity(fresh):
    robot = fresh.entities["robot"]
    fresh.engine.field("qpos")[0, 3:7] = torch.tensor([sqrt(0.5), 0, 0, sqrt(0.5)], dtype=torch.float64)
    fresh.engine.field("qvel")[0, :6] = torch.tensor([1.0, 0, 0, 0, -0.5, 0], dtype=torch.float64)
    zero = (0.0, 0.0)
    events.push_by_setting_velocity(
        fresh, some(fresh, 0), entity=robot,
        linear_velocity=[(0.5, 0.5), (2.0, 2.0), zero], angular_velocity=[(0.25, 0.25), zero, zero],
    )  # fmt: skip
    assert fresh.engine.field("qvel")[0, :6].tolist() == pytest.approx([1.5, 2, 0, 0, -0.75, 0], abs=1e-6)


def test_external_wrench_lasts_until_reset(fresh):
    robot = fresh.entities["robot"]
    bodies, names = robot.select("Bodies", ["leg_br", "torso"])
    assert names == ["leg_br", "torso"]
    events.apply_external_force_torque(
        fresh, some(fresh, 2), entity=robot, bodies=bodies, force=(3.0, 3.0), torque=(-1.0, -1.0)
    )
    wrench = fresh.engine.field("xfrc_applied")
    pushed = [robot.body_ids[robot.names["Bodies"].index(n)] for n in names]
    for body in range(fresh.engine.model.nbody):
        expected = [3, 3, 3, -1, -1, -1] if body in pushed else [0] * 6
        assert wrench[2, body].tolist() == expected
    assert not wrench[:2].any()
    fresh.engine.reset(some(fresh, 2))
    assert not wrench.any()


def test_reset_scene_to_default_resets_all_entities(fresh):
    for _ in range(5):
        fresh.step(torch.rand(3, 4))
    events.reset_scene_to_default(fresh, some(fresh, 1))
    expected = [0, 0, 0.35, 1, 0, 0, 0, 0.1, -0.1, 0.1, -0.1]
    assert fresh.engine.field("qpos")[1].tolist() == pytest.approx(expected, abs=1e-6)
    assert not fresh.engine.field("qvel")[1].any()
    assert fresh.engine.field("qvel")[0].any()


@pytest.mark.parametrize("event", [
    {"func": "reset_root_state_uniform", "mode": "reset"},
    {"func": "push_by_setting_velocity", "mode": "interval", "interval_range_s": [0.01, 0.01]},
])  # fmt: skip
def test_root_events_reject_fixed_robot(tmp_path, event):
    from support.worlds import PENDULUM_TASK, pendulum

    env = build(pendulum(tmp_path, edited(PENDULUM_TASK, events={"move": event})))
    with pytest.raises(TaskError, match="'robot' is fixed to the world"):  # noqa: PT012
        env.reset()
        env.step(torch.zeros(3, 1))


def test_progress_reward_is_exact_for_far_target(tmp_path):
    """Two distances of 1000 m in float32 differ by multiples of 0.06 mm."""
    env = build(critter(tmp_path), 3)
    env.reset()
    term = rewards.ProgressReward(env, entity=env.entities["robot"], target=(1000.0, 0.0, 0.0))
    env.engine.field("qpos")[:, 0] += torch.tensor([1e-3, 2.1e-3, -7.7e-3], dtype=torch.float64)
    env.sim.refresh()
    expected = torch.tensor([1e-3, 2.1e-3, -7.7e-3]) / env.step_dt
    torch.testing.assert_close(term(), expected, rtol=0, atol=1e-5)
    assert not term().any(), "nothing moved since"


def test_unlimited_joints_have_no_limit_penalty(tmp_path):
    from support.worlds import PENDULUM_TASK, pendulum

    terms = {"limits": {"func": "joint_pos_limits", "weight": -1.0},
             "ratio": {"func": "joint_pos_limits_penalty_ratio", "weight": -1.0}}  # fmt: skip
    env = build(pendulum(tmp_path, edited(PENDULUM_TASK, rewards=terms)))
    env.reset()
    env.engine.field("qpos")[:] = 50.0
    env.sim.refresh()
    robot = env.entities["robot"]
    assert rewards.joint_pos_limits(env, entity=robot, joints=slice(0, 1)).tolist() == [0, 0, 0]
    assert rewards.joints_at_limit(env, entity=robot, joints=slice(0, 1)).tolist() == [0, 0, 0]
    assert rewards.JointPosLimitsPenaltyRatio(env, entity=robot, joints=slice(0, 1))().tolist() == [0, 0, 0]


def test_soft_limits_shrink_around_middle(tmp_path):
    robot = {"robot": {"model": "critter.xml", "soft_joint_pos_limit_factor": 0.5,
                       "joints": {".*": {"kp": 20.0}, "hip_fl": {"range": [-0.2, 1.0]}}}}  # fmt: skip
    env = build(critter(tmp_path, edited(CRITTER_TASK, scene={"entities": robot})), 2)
    soft = env.entities["robot"].data.soft_joint_pos_limits
    assert soft[0].tolist() == pytest.approx([0.1, 0.7])
    assert soft[1].tolist() == pytest.approx([-LIMIT / 2, LIMIT / 2])

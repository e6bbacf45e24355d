"""Data that Isaac Lab's terms read and write, compared with the engine; rotations compared with MuJoCo."""

import math

import mujoco
import numpy as np
import pytest
import torch
from support.worlds import CRITTER, CRITTER_TASK, build, critter, edited, write

from rlcli.errors import TaskError
from rlcli.scene.names import NameProblem
from rlcli_isaaclab.runtime import facade_of
from rlcli_isaaclab.utils import math as lab

torch.set_num_threads(1)


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    """Yield four moving critters behind Isaac Lab's environment class."""
    built = build(critter(tmp_path_factory.mktemp("critter")))
    yield facade_of(built)
    built.close()


@pytest.fixture
def robot(env):
    env.reset(seed=3)
    for _ in range(3):
        env.step(torch.rand(4, 4, generator=torch.Generator().manual_seed(1)))
    return env.scene["robot"]


def random_pose(rows):
    generator = torch.Generator().manual_seed(5)
    position = torch.rand(rows, 3, generator=generator) + torch.tensor([0.0, 0.0, 1.0])
    return torch.cat([position, lab.normalize(torch.randn(rows, 4, generator=generator))], dim=1)


def test_written_root_state_is_read_back_in_selected_rows(robot):
    before = robot.data.root_state_w.clone()
    rows = torch.tensor([3, 1])
    written = torch.cat(
        [random_pose(2), torch.tensor([[1.0, -2.0, 0.5, 0.3, -0.7, 2.0], [0.0, 1.0, 0.0, -1.0, 0.2, 0.1]])], 1
    )
    robot.write_root_state_to_sim(written, env_ids=rows)
    assert torch.allclose(robot.data.root_state_w[rows], written, atol=1e-6)
    assert torch.equal(robot.data.root_state_w[[0, 2]], before[[0, 2]])
    assert torch.allclose(robot.data.root_pose_w[rows], written[:, :7], atol=1e-6)
    assert torch.allclose(robot.data.root_vel_w[rows], written[:, 7:], atol=1e-6)


def test_velocities_without_link_are_those_of_the_centre_of_mass(tmp_path):
    inertia = '<inertial pos="0.05 0.02 -0.03" mass="3" diaginertia="0.02 0.05 0.06"/>'
    xml = CRITTER.replace('<freejoint name="root"/>', f'<freejoint name="root"/>{inertia}')
    env = facade_of(build(write(tmp_path / "off", edited(CRITTER_TASK), critter_xml=xml), 4))
    env.reset(seed=3)
    robot, rows = env.scene["robot"], torch.tensor([3, 1])
    written = torch.cat([random_pose(2), torch.randn(2, 6, generator=torch.Generator().manual_seed(2))], dim=1)
    arm = lab.quat_apply(written[:, 3:7], torch.tensor([[0.05, 0.02, -0.03]] * 2))
    turning = torch.linalg.cross(written[:, 10:], arm)
    for write_state, of_com, of_origin in (
        (robot.write_root_state_to_sim, 0.0, -turning),
        (robot.write_root_link_state_to_sim, turning, 0.0),
    ):
        write_state(written, env_ids=rows)
        env.managed.engine.forward(env.managed._select_all())
        env.managed.sim.refresh()
        data = robot.data
        com, origin = written[:, 7:10] + of_com, written[:, 7:10] + of_origin
        for found, expected in (
            (data.root_lin_vel_w, com), (data.root_com_lin_vel_w, com), (data.root_vel_w[:, :3], com),
            (data.root_state_w[:, 7:10], com), (data.body_lin_vel_w[:, 0], com), (data.body_state_w[:, 0, 7:10], com),
            (lab.quat_apply(data.root_quat_w, data.root_lin_vel_b), com), (data.body_vel_w[:, 0, :3], com),
            (data.root_link_lin_vel_w, origin), (data.root_link_vel_w[:, :3], origin),
            (data.root_link_state_w[:, 7:10], origin), (data.body_link_lin_vel_w[:, 0], origin),
            (data.body_link_state_w[:, 0, 7:10], origin), (data.body_link_vel_w[:, 0, :3], origin),
            (lab.quat_apply(data.root_quat_w, data.root_link_lin_vel_b), origin),
        ):  # fmt: skip
            torch.testing.assert_close(found[rows], expected, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(data.root_link_ang_vel_w[rows], written[:, 10:], atol=1e-5, rtol=1e-5)


def test_written_joint_is_read_back_and_others_keep(robot):
    position, velocity = robot.data.joint_pos.clone(), robot.data.joint_vel.clone()
    ids, names = robot.find_joints(["hip_br", "hip_fl"])
    assert names == [robot.joint_names[i] for i in ids]
    target = torch.tensor([[0.3, -0.2]])
    robot.write_joint_position_to_sim(target, joint_ids=torch.tensor(ids), env_ids=[2])
    robot.write_joint_velocity_to_sim(10 * target, joint_ids=torch.tensor(ids), env_ids=[2])
    position[2, ids], velocity[2, ids] = target[0], 10 * target[0]
    assert torch.allclose(robot.data.joint_pos, position)
    assert torch.allclose(robot.data.joint_vel, velocity)
    robot.write_joint_state_to_sim(torch.full((4, 4), 0.1), torch.full((4, 4), -1.0))
    assert torch.allclose(robot.data.joint_pos, torch.tensor(0.1))
    assert torch.allclose(robot.data.joint_vel, torch.tensor(-1.0))


def test_find_joints_uses_model_order_unless_preserve_order(robot):
    model = robot.joint_names
    assert robot.find_joints(["hip_f.*", "hip_br"])[1] == [n for n in model if n in ("hip_fl", "hip_fr", "hip_br")]
    assert robot.find_joints(["hip_br", "hip_fl"], preserve_order=True)[1] == ["hip_br", "hip_fl"]
    assert robot.find_joints(".*l", joint_subset=["hip_bl", "hip_br"])[1] == ["hip_bl"]
    assert robot.find_bodies("leg_f.")[1] == ["leg_fl", "leg_fr"]


def test_bodies_limits_and_directions_equal_engine(env, robot):
    states = robot.data.body_state_w
    assert states.shape == (4, robot.num_bodies, 13)
    torso = robot.body_names.index("torso")
    assert torch.allclose(states[:, torso, :7], robot.data.root_pose_w, atol=1e-5)
    assert torch.allclose(robot.data.joint_pos_limits, torch.tensor([-math.pi / 3, math.pi / 3]).expand(4, 4, 2))
    assert (robot.data.soft_joint_pos_limits.abs() <= robot.data.joint_pos_limits.abs()).all()
    assert torch.equal(robot.data.GRAVITY_VEC_W, torch.tensor([0.0, 0.0, -1.0]).expand(4, 3))
    robot.write_root_pose_to_sim(torch.tensor([[0, 0, 1, math.cos(0.4), 0, 0, math.sin(0.4)]]).expand(4, 7))
    assert torch.allclose(robot.data.heading_w, torch.tensor(0.8), atol=1e-6)
    assert not robot.is_fixed_base
    assert robot.num_instances == env.scene.num_envs == 4


def test_scene_is_mapping_and_errors_list_names(env):
    assert list(env.scene) == ["robot"]
    assert len(env.scene) == 1
    assert env.scene.articulations["robot"] is env.scene["robot"]
    assert env.scene.rigid_objects == {}
    assert torch.equal(env.scene.env_origins, torch.zeros(4, 3))
    with pytest.raises(KeyError, match="no 'terrain' in the scene; entities and sensors: robot"):
        env.scene["terrain"]
    with pytest.raises(AttributeError, match=r"data has no 'joint_poss'; did you mean 'joint_pos"):
        env.scene["robot"].data.joint_poss  # noqa: B018
    with pytest.raises(TaskError, match=r"root_physx_view\.get_forces cannot be used: rlcli has no PhysX"):
        env.scene["robot"].root_physx_view.get_forces()
    with pytest.raises(AttributeError, match="env has no 'step_dtt'; did you mean 'step_dt'"):
        env.step_dtt  # noqa: B018
    assert not hasattr(env.scene["robot"], "actuators")


def test_managers_report_results_of_step(env):
    env.reset(seed=0)
    env.scene["robot"].write_root_pose_to_sim(torch.tensor([[0.0, 0.0, 1.0, 0.7, 0.7, 0.0, 0.0]]), env_ids=[1])
    before = env.common_step_counter.clone()
    _, _, terminated, truncated, extras = env.step(torch.zeros(4, 4))
    assert bool(terminated[1])
    assert torch.equal(env.termination_manager.get_term("tilt"), env.termination_manager.fired["tilt"])
    assert torch.equal(env.termination_manager.dones, terminated | truncated)
    assert torch.equal(env.reset_terminated, terminated)
    assert torch.equal(env.reset_time_outs, truncated)
    assert torch.equal(env.reset_buf, terminated | truncated)
    assert extras["log"]["Episode_Termination/tilt"] == 1
    assert env.common_step_counter == before + 1
    assert env.termination_manager.active_terms == ["time_out", "tilt", "low"]
    assert env.reward_manager.active_terms[:2] == ["alive", "fell"]
    assert env.max_episode_length_s == 0.6
    with pytest.raises(NameProblem, match="no action 'arms'; actions: legs"):
        env.action_manager.get_term("arms")
    with pytest.raises(NameProblem, match="no termination 'tlit'; terminations: time_out"):
        env.termination_manager.get_term("tlit")


def test_spaces_are_batched(env):
    obs, _ = env.reset()
    assert env.single_action_space.shape == (4,)
    assert env.action_space.shape == (4, 4)
    for name, rows in obs.items():
        assert env.observation_space[name].shape == tuple(rows.shape)
        assert env.single_observation_space[name].shape == tuple(rows.shape[1:])


# --- rotations ---


def quats(rows=16, seed=0):
    return lab.normalize(torch.randn(rows, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)))


def vectors(rows=16, seed=1):
    return torch.randn(rows, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def with_mujoco(function, size, *arguments):
    """Apply a function of MuJoCo row by row."""
    rows = []
    for row in zip(*(a.numpy() for a in arguments), strict=True):
        result = np.zeros(size)
        function(result, *row)
        rows.append(result)
    return torch.from_numpy(np.stack(rows))


def test_rotated_vectors_equal_mujoco():
    q, v = quats(), vectors()
    turned = with_mujoco(lambda out, quat, vec: mujoco.mju_rotVecQuat(out, vec, quat), 3, q, v)
    assert torch.allclose(lab.quat_apply(q, v), turned)
    assert torch.allclose(lab.quat_apply_inverse(q, turned), v)
    assert torch.allclose(lab.quat_apply(q[:1], v[:5]), lab.quat_apply(q[:1].expand(5, 4), v[:5]))
    many = lab.quat_apply(q.reshape(4, 4, 4), v.reshape(4, 4, 3))
    assert torch.allclose(many.reshape(16, 3), turned)


def test_inverse_and_error_magnitude_equal_mujoco():
    a, b = quats(), quats(seed=7)
    assert torch.allclose(lab.quat_inv(a), with_mujoco(mujoco.mju_negQuat, 4, a))
    way = with_mujoco(mujoco.mju_subQuat, 3, a, b).norm(dim=1)
    angle = lab.quat_error_magnitude(a, b)
    assert torch.allclose(angle, torch.minimum(way, 2 * torch.pi - way))
    assert torch.allclose(lab.quat_error_magnitude(a, -a), torch.zeros(16, dtype=torch.float64), atol=1e-7)
    assert (lab.quat_unique(torch.cat([a, -a]))[:, 0] >= 0).all()
    assert torch.equal(lab.quat_unique(a), lab.quat_unique(-a))


def test_details_that_isaac_lab_documents():
    q = quats()
    assert torch.allclose(lab.quat_mul(q1=lab.quat_inv(2.0 * q, eps=1e-9), q2=2.0 * q)[:, 0], torch.ones(16).double())
    angle = torch.tensor([3.0, -3.0, 1.0, -1.0]) * torch.pi
    assert lab.wrap_to_pi(angles=angle).tolist() == pytest.approx([math.pi, -math.pi, math.pi, -math.pi])
    small = lab.quat_from_angle_axis(torch.full((1,), 1e-4), torch.tensor([[0.0, 0.0, 1.0]]))
    assert lab.quat_error_magnitude(small, torch.tensor([[1.0, 0.0, 0.0, 0.0]])).item() == pytest.approx(1e-4, rel=1e-4)
    turned = lab.quat_box_plus(-q, torch.zeros(16, 3).double())
    assert torch.allclose(turned, lab.quat_unique(q))
    flip = torch.tensor([-0.2, 0.1, 0.1, 0.9]).double()
    flip = flip / flip.norm()
    assert torch.allclose(lab.quat_from_matrix(lab.matrix_from_quat(flip)), flip)  # the largest number is positive
    points = lab.transform_points(torch.tensor([[1.0, 0.0, 0.0]]).double(), vectors(), q)
    assert torch.allclose(points[:, 0], lab.quat_apply(q, torch.eye(1, 3).double().expand(16, 3)) + vectors())
    assert lab.quat_rotate(q=q, v=vectors()).equal(lab.quat_apply(q, vectors()))
    surface = lab.sample_cylinder(2.0, (0.5, 1.0), 200, "cpu")
    assert torch.allclose(surface[:, :2].norm(dim=1), torch.full((200,), 2.0))
    assert surface[:, 2].min() >= 0.5
    assert surface[:, 2].max() <= 1.0
    ends = lab.sample_triangle(-1.0, 1.0, 4000, "cpu")
    assert ends.square().mean().item() == pytest.approx(0.5, abs=0.03)  # of the density |x|


def test_euler_angles_round_trip():
    q = quats()
    angles = lab.euler_xyz_from_quat(q)
    assert all(bool((a.abs() <= torch.pi).all()) for a in angles)
    assert min(a.min() for a in angles) < 0.0
    wrapped = lab.euler_xyz_from_quat(q, wrap_to_2pi=True)
    assert all(bool(((a >= 0) & (a < 2 * torch.pi)).all()) for a in wrapped)
    assert all(torch.allclose(a % (2 * torch.pi), b) for a, b in zip(angles, wrapped, strict=True))
    again = lab.quat_from_euler_xyz(*angles)
    assert torch.allclose(lab.quat_unique(again), lab.quat_unique(q), atol=1e-7)
    roll, pitch, yaw = (torch.tensor([x], dtype=torch.float64) for x in (0.1, -0.2, 0.3))
    turned = lab.quat_apply(lab.quat_from_euler_xyz(roll, pitch, yaw), torch.tensor([[1.0, 0.0, 0.0]]).double())
    expected = [math.cos(0.3) * math.cos(0.2), math.sin(0.3) * math.cos(0.2), math.sin(0.2)]
    assert turned[0].tolist() == pytest.approx(expected)


def test_yaw_rotation_keeps_height_and_heading():
    q, v = quats(), vectors()
    level = lab.yaw_quat(q)
    assert torch.equal(level[:, 1:3], torch.zeros(16, 2, dtype=torch.float64))
    x = torch.tensor([[1.0, 0.0, 0.0]]).double().expand(16, 3)
    full, flat = lab.quat_apply(q, x), lab.quat_apply_yaw(q, x)
    assert torch.allclose(torch.atan2(full[:, 1], full[:, 0]), torch.atan2(flat[:, 1], flat[:, 0]))
    assert torch.allclose(lab.quat_apply_yaw(q, v)[:, 2], v[:, 2])


def test_combine_and_subtract_frames_are_inverse():
    t01, q01, t12, q12 = vectors(), quats(), vectors(seed=8), quats(seed=9)
    t02, q02 = lab.combine_frame_transforms(t01, q01, t12, q12)
    points = vectors(seed=11)
    through = t01 + lab.quat_apply(q01, t12 + lab.quat_apply(q12, points))
    assert torch.allclose(t02 + lab.quat_apply(q02, points), through)
    back, turn = lab.subtract_frame_transforms(t01, q01, t02, q02)
    assert torch.allclose(back, t12)
    assert torch.allclose(lab.quat_unique(turn), lab.quat_unique(q12))
    place, same = lab.combine_frame_transforms(t01, q01)
    assert torch.equal(place, t01)
    assert torch.equal(same, q01)
    origin, turn = lab.subtract_frame_transforms(t01, q01)
    assert torch.allclose(t01 + lab.quat_apply(q01, origin), torch.zeros(16, 3, dtype=torch.float64), atol=1e-12)
    assert torch.equal(turn, lab.quat_conjugate(q01))


def test_scale_and_unscale_are_inverse():
    lower, upper = torch.tensor([-1.0, 0.0]), torch.tensor([3.0, 10.0])
    ends = torch.stack([lower, upper, 0.5 * (lower + upper)])
    assert torch.equal(lab.scale_transform(ends, lower, upper), torch.tensor([[-1.0, -1.0], [1.0, 1.0], [0.0, 0.0]]))
    x = torch.tensor([[0.3, 7.0]])
    assert torch.allclose(lab.unscale_transform(lab.scale_transform(x, lower, upper), lower, upper), x)
    assert torch.equal(
        lab.saturate(torch.tensor([[-5.0, 20.0], [1.0, 1.0]]), lower, upper), torch.tensor([[-1.0, 10.0], [1.0, 1.0]])
    )
    assert torch.equal(lab.copysign(-2.0, torch.tensor([-0.5, 3.0])), torch.tensor([-2.0, 2.0]))


def test_samples_are_in_range_and_spread():
    torch.manual_seed(0)
    even = lab.sample_uniform(-1.0, 3.0, (4000,), "cpu")
    assert -1.0 <= float(even.min()) < -0.9 < 2.9 < float(even.max()) < 3.0
    assert lab.sample_uniform(0.0, 1.0, 7, "cpu").shape == (7,)
    bell = lab.sample_gaussian(2.0, 0.5, (4000,), "cpu")
    assert float(bell.mean()) == pytest.approx(2.0, abs=0.05)
    assert float(bell.std()) == pytest.approx(0.5, abs=0.05)
    wide = lab.sample_log_uniform(0.01, 100.0, (4000,), "cpu")
    assert float(wide.min()) >= 0.01
    assert float(wide.max()) <= 100.0
    assert float(wide.median()) == pytest.approx(1.0, rel=0.3)  # half of the sampled decades are below 1
    turns = lab.random_orientation(4000, "cpu")
    assert torch.allclose(turns.norm(dim=1), torch.ones(4000))
    up = lab.quat_apply(turns, torch.tensor([0.0, 0.0, 1.0]).expand(4000, 3))
    assert float(up.mean(dim=0).abs().max()) < 0.05

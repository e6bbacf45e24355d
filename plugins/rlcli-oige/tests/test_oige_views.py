"""Data that views read from and write to the simulation, and every attribute of `domain_randomization:`."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
import yaml as yaml_module
from reacher import ARM, TASK, YAML, arm_folder

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.errors import TaskError
from rlcli.registry import find_task
from rlcli_oige import maths, rotations

torch.set_num_threads(1)
IDLE = torch.zeros(4, 1)
STILL = TASK.replace("torch_rand_float(-0.1, 0.1,", "torch_rand_float(0.0, 0.0,").replace(
    "limit_of_the_angle()", "99.0"
)
STILL = STILL.replace("from rlcli_oige import 99.0\n", "")


def build(folder):
    env = make_env(resolve(find_task(str(folder))), seed=3)
    env.reset()
    return env


@pytest.fixture
def env(tmp_path):
    return build(arm_folder(tmp_path / "arm", task=STILL))


def forward(env):
    env.engine.forward(env._select_all())
    env.sim.refresh()


def test_written_mass_is_read_back_and_inertia_scales(env):
    boxes = env.task._boxes
    before = boxes.get_inertias()
    boxes.set_masses(torch.tensor([6.0, 1.5]), indices=torch.tensor([2, 0]))
    assert boxes.get_masses().tolist() == [1.5, 3.0, 6.0, 3.0]
    factor = torch.tensor([0.5, 1.0, 2.0, 1.0])
    assert torch.allclose(boxes.get_inertias(), before * factor[:, None])
    assert torch.allclose(
        boxes.get_inertias(torch.tensor([3]))[0].reshape(3, 3).diagonal(), before[3].reshape(3, 3).diagonal()
    )
    arms = env.task._arms
    arms.set_body_masses(torch.tensor([[9.0]]), indices=[1], body_indices=[2])
    masses = arms.get_body_masses()
    assert masses[1, 2] == 9.0
    assert torch.equal(masses[[0, 2, 3]], masses[[0]].expand(3, -1))
    assert torch.equal(arms.get_body_masses([1], [2]), torch.tensor([[9.0]]))


def test_disabled_gravity_stops_fall_and_enabled_restarts_it(tmp_path):
    lifting = STILL.replace(
        "    def post_reset(self):\n", "    def post_reset(self):\n        self.lift = self._boxes.disable_gravities\n"
    )
    env = build(arm_folder(tmp_path / "arm", task=lifting))
    boxes = env.task._boxes
    boxes.disable_gravities(torch.tensor([1]))
    height = boxes.get_world_poses()[0][:, 2].clone()
    for _ in range(3):
        env.step(IDLE)
    fallen = height - boxes.get_world_poses()[0][:, 2]
    assert fallen[1].abs() < 1e-6
    assert (fallen[[0, 2, 3]] > 0.01).all()
    boxes.enable_gravities(torch.tensor([1]))
    env.step(IDLE)
    assert boxes.get_linear_velocities()[1, 2] < -0.1


def test_disable_gravities_outside_task_file_is_refused(env):
    with pytest.raises(TaskError, match="view 'box_view': the model was built without gravity compensation"):
        env.task._boxes.disable_gravities()


def test_linear_and_angular_velocities_are_set_separately(env):
    boxes = env.task._boxes
    turned = torch.tensor([[0.6, 0.8, 0.0, 0.0]]).repeat(4, 1)
    boxes.set_world_poses(None, turned)
    boxes.set_velocities(torch.arange(24.0).reshape(4, 6))
    boxes.set_linear_velocities(torch.full((1, 3), 7.0), indices=torch.tensor([2]))
    boxes.set_angular_velocities(torch.full((1, 3), -2.0), indices=torch.tensor([0]))
    expected = torch.arange(24.0).reshape(4, 6)
    expected[2, :3], expected[0, 3:] = 7.0, -2.0
    assert torch.allclose(boxes.get_velocities(), expected, atol=1e-5)
    assert torch.allclose(boxes.get_linear_velocities([2]), torch.full((1, 3), 7.0))
    assert torch.allclose(boxes.get_angular_velocities([0]), torch.full((1, 3), -2.0), atol=1e-6)


def test_link_velocity_is_that_of_center_of_mass(env):
    arms, links = env.task._arms, env.task._links
    arms.set_joint_positions(torch.zeros(4, 3))
    arms.set_joint_velocities(torch.tensor([[0.0, 2.0, 0.0]]).repeat(4, 1))
    forward(env)
    speed = links.get_velocities().reshape(4, 2, 6)
    assert torch.allclose(speed[:, 1, 3:], torch.tensor([0.0, 2.0, 0.0]), atol=1e-5), "the right link turns about y"
    assert torch.allclose(speed[:, 1, :3], torch.tensor([0.3, 0.0, 0.0]), atol=1e-5), "0.15 m above the joint"
    assert torch.allclose(speed[:, 0], torch.zeros(6), atol=1e-5)


def test_gains_belong_to_drives_and_other_joints_have_none(env):
    arms = env.task._arms
    column = arms.get_dof_index("right_a")
    stiffness, damping = arms.get_gains()
    assert stiffness[0].tolist() == [5.0 if c == column else 0.0 for c in range(3)]
    assert damping[0, column] == 0.5
    arms.set_gains(kps=torch.tensor([[40.0]]), indices=[1], joint_indices=[column])
    arms.set_gains(kds=torch.tensor([[2.0]]), indices=[3], joint_indices=[column])
    stiffness, damping = arms.get_gains()
    assert stiffness[:, column].tolist() == [5.0, 40.0, 5.0, 5.0]
    assert damping[:, column].tolist() == [0.5, 0.5, 0.5, 2.0]
    arms.set_joint_position_targets(torch.tensor([[0.0, 0.5, 0.0]]).repeat(4, 1))
    env.step(IDLE)
    effort = arms.get_measured_joint_efforts()[:, column]
    assert effort[1] > 2 * effort[0] > 0, "the stiffer drive pulls harder"


MOTOR = ARM.replace(
    "<actuator>", '<actuator><motor name="left_a" joint="left_a" gear="2" ctrllimited="true" ctrlrange="-1.5 1.5"/>'
)


def test_efforts_are_limited_by_max_efforts(tmp_path):
    folder = arm_folder(tmp_path / "arm", task=STILL)
    (folder / "arm.xml").write_text(MOTOR)
    env = build(folder)
    arms = env.task._arms
    column = arms.get_dof_index("left_a")
    assert arms.get_max_efforts()[:, column].tolist() == [3.0] * 4, "the control's limit times the gear"
    assert arms.get_max_efforts(joint_indices=[arms.get_dof_index("left_b")]).isinf().all()
    arms.set_max_efforts(torch.tensor([[1.0]]), indices=[2], joint_indices=[column])
    driven = arms.get_dof_index("right_a")
    arms.set_max_efforts(torch.tensor([[0.5]]), indices=[0], joint_indices=[driven])
    motor = arms._drives["motor"][1][arms._drives["motor"][0] == column]
    for target in (5.0, -5.0):
        arms.set_joint_efforts(torch.full((4, 2), target), joint_indices=[column, driven])
        control = env.engine.field("ctrl")[:, motor].flatten() / target
        assert (5 * control).tolist() == pytest.approx([1.5, 1.5, 0.5, 1.5]), "half of the effort: the gear is 2"
        beside = env.engine.field("qfrc_applied")[:, arms._dof_columns[driven]] / target
        assert (5 * beside).tolist() == pytest.approx([0.5, 5.0, 5.0, 5.0])


def test_apply_action_sets_targets_and_efforts(env):
    arms = env.task._arms
    message = {"joint_positions": torch.full((4, 1), 0.2), "joint_efforts": torch.full((4, 1), 0.7)}
    arms.apply_action(SimpleNamespace(**message, joint_velocities=None, joint_indices=[arms.get_dof_index("right_a")]))
    assert torch.allclose(arms.get_joint_position_targets(joint_indices=[1]), torch.tensor(0.2))
    assert torch.allclose(arms.get_applied_joint_efforts(joint_indices=[1]), torch.tensor(0.7))
    assert torch.allclose(env.engine.field("ctrl")[:, arms._drives["position"][1]].float(), torch.full((4, 1), 0.2))


EARLY = """        super().set_up_scene(scene)
        early = RigidPrimView("/World/envs/.*/box", name="early")
        early.get_masses()
"""


def test_view_before_simulation_gives_hint(tmp_path):
    task = STILL.replace("        super().set_up_scene(scene)\n", EARLY)
    with pytest.raises(TaskError, match="view 'early' is not connected to a simulation"):
        build(arm_folder(tmp_path / "arm", task=task))


def test_duplicate_view_name_and_missing_object_are_refused(env):
    from rlcli_oige import RigidPrimView

    registry = env.handle.world.scene
    assert registry.object_exists("box_view")
    assert registry.get_object("box_view") is env.task._boxes
    with pytest.raises(TaskError, match="two views have the name 'box_view'"):
        registry.add(RigidPrimView("/World/envs/.*/ball", name="box_view"))
    with pytest.raises(TaskError, match="the scene has no view 'box_veiw'"):
        registry.get_object("box_veiw")
    registry.remove_object("box_view")
    assert not registry.object_exists("box_view")


# --- randomisation of each attribute ---

READ = {
    "stiffness": lambda env: env.task._arms.get_gains()[0][:, 1],
    "damping": lambda env: env.task._arms.get_gains()[1][:, 1],
    "joint_friction": lambda env: env.engine.expand("dof_frictionloss")[:, env.task._arms._dof_columns],
    "joint_armatures": lambda env: env.engine.expand("dof_armature")[:, env.task._arms._dof_columns],
    "max_efforts": lambda env: env.task._arms.get_max_efforts(),
    "lower_dof_limits": lambda env: env.engine.expand("jnt_range")[:, env.task._arms.entity.joint_ids, 0],
    "upper_dof_limits": lambda env: env.engine.expand("jnt_range")[:, env.task._arms.entity.joint_ids, 1],
    "body_masses": lambda env: env.task._arms.get_body_masses(),
    "body_inertias": lambda env: env.engine.expand("body_inertia")[:, env.task._arms._body_ids],
    "joint_positions": lambda env: env.task._arms.get_joint_positions(),
    "joint_velocities": lambda env: env.task._arms.get_joint_velocities(),
}


def gate(operation, low, high, **more):
    return {"operation": operation, "distribution": "uniform", "distribution_parameters": [low, high], **more}


def randomized(place, params, **more):
    block = {"domain_randomization": {"randomize": True, **more, "randomization_params": params}}
    return build(arm_folder(place / "arm", yaml=YAML + yaml_module.safe_dump(block), task=STILL))


@pytest.mark.parametrize("attribute", READ)
def test_robot_attribute_is_sampled_per_env_within_bounds(tmp_path, attribute):
    env = randomized(
        tmp_path, {"articulation_views": {"arm_view": {attribute: {"on_reset": gate("direct", 0.25, 0.75)}}}}
    )
    values = READ[attribute](env)
    assert ((values >= 0.25) & (values <= 0.75)).all()
    rows = values.reshape(4, -1)
    assert len({tuple(row.tolist()) for row in rows}) == 4, "no two environments alike"


def test_geom_friction_is_second_material_property(tmp_path):
    entry = gate("direct", 0, 0) | {"distribution_parameters": [[0.0, 0.3, 0.0], [0.0, 0.6, 0.0]]}
    env = randomized(tmp_path, {"articulation_views": {"arm_view": {"material_properties": {"on_reset": entry}}}})
    model = env.engine.model
    geoms = [g for g in range(model.ngeom) if int(model.geom_bodyid[g]) in env.task._arms._body_ids]
    friction = env.engine.expand("geom_friction")[:, geoms, 0]
    assert ((friction >= 0.3) & (friction <= 0.6)).all()
    others = [g for g in range(model.ngeom) if g not in geoms]
    assert torch.equal(
        env.engine.expand("geom_friction")[:, others], torch.tensor(model.geom_friction[others]).expand(4, -1, -1)
    )


@pytest.mark.parametrize(
    ("attribute", "columns", "read"),
    [
        ("position", 3, lambda box: box.get_world_poses()[0]),
        ("linear_velocity", 3, lambda box: box.get_velocities()[:, :3]),
        ("angular_velocity", 3, lambda box: box.get_velocities()[:, 3:]),
        ("velocity", 6, lambda box: box.get_velocities()),
    ],
)
def test_body_state_is_sampled_at_each_reset(tmp_path, attribute, columns, read):
    env = randomized(
        tmp_path, {"rigid_prim_views": {"box_view": {attribute: {"on_reset": gate("direct", 0.25, 0.75)}}}}
    )
    values = read(env.task._boxes)
    assert values.shape == (4, columns)
    assert ((values >= 0.249) & (values <= 0.751)).all()
    assert values.unique(dim=0).shape[0] == 4


@pytest.mark.parametrize(
    ("operation", "yaw", "expected"), [("additive", 0.5, 0.8), ("direct", 0.5, 0.5), ("scaling", 0.5, 0.15)]
)
def test_orientation_is_changed_by_euler_angles(tmp_path, operation, yaw, expected):
    """Check the yaw of boxes that start with yaw 0.3 and no roll or pitch."""
    entry = gate(operation, 0, 0, frequency_interval=1) | {
        "distribution_parameters": [[0.0, 0.0, yaw], [0.0, 0.0, yaw]]
    }
    block = {"rigid_prim_views": {"box_view": {"orientation": {"on_interval": entry}}}}
    yaml = YAML + yaml_module.safe_dump({"domain_randomization": {"randomize": True, "randomization_params": block}})
    env = build(arm_folder(tmp_path / "arm", yaml=yaml, task=STILL))
    half = torch.tensor([0.15])
    env.task._boxes.set_world_poses(None, torch.cat([half.cos(), 0 * half, 0 * half, half.sin()]).repeat(4, 1))
    env.step(IDLE)
    angles = rotations.get_euler_xyz(env.task._boxes.get_world_poses()[1])
    assert torch.allclose(angles[2], torch.tensor(expected), atol=1e-4)
    assert torch.allclose(torch.cat(angles[:2]) % (2 * torch.pi), torch.tensor(0.0), atol=1e-4)


def test_sampled_force_moves_body(tmp_path):
    entry = gate("direct", 0, 0, frequency_interval=1) | {"distribution_parameters": [[9.0, 0.0, 0.0], [9.0, 0.0, 0.0]]}
    env = randomized(tmp_path, {"rigid_prim_views": {"box_view": {"force": {"on_interval": entry}}}})
    before = env.task._boxes.get_velocities()[:, 0].clone()
    for _ in range(2):
        env.step(IDLE)
    gained = env.task._boxes.get_velocities()[:, 0] - before
    assert (gained > 0.05).all(), "9 N on 3 kg for 0.02 s or more"


@pytest.mark.parametrize(
    ("attribute", "read"), [("mass", "get_masses"), ("density", "get_masses"), ("inertia", "get_inertias")]
)
def test_sampled_mass_is_part_of_saved_state(tmp_path, attribute, read):
    env = randomized(tmp_path, {"rigid_prim_views": {"box_view": {attribute: {"on_reset": gate("scaling", 0.5, 2.0)}}}})
    values = getattr(env.task._boxes, read)()
    assert values.unique(dim=0).shape[0] == 4
    state = env.state_dict()
    for _ in range(13):
        env.step(IDLE)
    assert not torch.equal(getattr(env.task._boxes, read)(), values)
    env.load_state_dict(state)
    assert torch.equal(getattr(env.task._boxes, read)(), values)


# --- mathematics ---


def quats(count=50):
    return torch.nn.functional.normalize(torch.randn(count, 4, generator=torch.Generator().manual_seed(1)), dim=1)


def test_rotation_vector_and_angle_axis_round_trip():
    q = quats()
    same = [
        rotations.exp_map_to_quat(rotations.quat_to_exp_map(q)),
        rotations.matrix_to_quaternion(rotations.quats_to_rot_matrices(q)),
        rotations.wxyz2xyzw(rotations.xyzw2wxyz(q)),
        rotations.quat_from_angle_axis(*rotations.quat_angle_axis(q)),
    ]
    for other in same:
        assert ((other * q).sum(dim=1).abs() > 1 - 1e-5).all()
    angle, axis = rotations.quat_to_angle_axis(q)
    assert (angle.abs() <= torch.pi + 1e-6).all()
    assert torch.allclose(axis.norm(dim=1), torch.ones(50), atol=1e-5)
    degrees = torch.tensor([[10.0, -20.0, 30.0]])
    radians = maths.deg2rad(degrees)
    assert torch.allclose(maths.rad2deg(radians), degrees)
    assert torch.allclose(
        rotations.euler_angles_to_quats(degrees, degrees=True), rotations.euler_angles_to_quats(radians)
    )
    assert torch.allclose(rotations.quat_from_euler_xyz(*radians.T), rotations.euler_angles_to_quats(radians))


def test_transform_of_points_and_directions():
    q, t, v = quats(), torch.ones(50, 3), torch.randn(50, 3, generator=torch.Generator().manual_seed(2))
    moved = rotations.tf_apply(q, t, v)
    assert torch.allclose(rotations.tf_apply(*rotations.tf_inverse(q, t), moved), v, atol=1e-5)
    assert torch.allclose(moved - t, rotations.tf_vector(q, v), atol=1e-6)
    assert torch.equal(rotations.get_basis_vector(q, v), rotations.tf_vector(q, v))
    assert rotations.get_axis_params(0.4, 2) == [0.0, 0.0, 0.4]
    assert rotations.get_axis_params(1.0, 1, x_value=0.5) == [0.5, 1.0, 0.0]


def test_scale_and_unscale_are_inverse():
    lower, upper = torch.tensor([-1.0, 0.0]), torch.tensor([3.0, 10.0])
    ends = torch.stack([lower, upper])
    assert torch.equal(maths.scale_transform(ends, lower, upper), torch.tensor([[-1.0, -1.0], [1.0, 1.0]]))
    assert torch.equal(maths.unscale_transform(maths.scale_transform(ends, lower, upper), lower, upper), ends)
    assert maths.unscale_np(ends.numpy(), -1.0, 9.0)[1].tolist() == pytest.approx([-0.2, 1.2])
    assert maths.scale_np(maths.unscale_np(ends.numpy(), -1.0, 9.0), -1.0, 9.0) == pytest.approx(ends.numpy(), abs=1e-6)
    assert torch.equal(maths.saturate(torch.tensor([-9.0, 99.0]), lower, upper), torch.tensor([-1.0, 10.0]))
    assert torch.equal(maths.copysign(-2.0, torch.tensor([-0.1, 5.0])), torch.tensor([-2.0, 2.0]))
    directions = maths.torch_random_dir_2((100, 1), "cpu")
    assert torch.allclose(directions.norm(dim=1), torch.ones(100))
    turned = maths.normalize_angle(torch.tensor([7.0, -7.0, 0.5]))
    assert torch.allclose(turned, torch.tensor([7.0 - 2 * torch.pi, 2 * torch.pi - 7.0, 0.5]), atol=1e-5)


def test_set_seed_seeds_all_three_generators():
    import random

    import numpy as np

    draws = []
    for _ in range(2):
        assert maths.set_seed(5) == 5
        draws.append((random.random(), float(np.random.rand()), float(torch.rand(()))))
    assert draws[0] == draws[1]
    assert maths.set_seed(-1, torch_deterministic=True) == 42


def test_root_velocity_is_that_of_center_of_mass(tmp_path):
    offset = ARM.replace(
        '<geom type="sphere" size="0.05" mass="1"',
        '<freejoint/><geom type="sphere" size="0.05" pos="0.06 0 0" mass="99"',
    )
    folder = arm_folder(tmp_path / "arm")
    (folder / "arm.xml").write_text(offset)
    env = build(folder)
    env.reset()
    arms, generator = env.task._arms, torch.Generator().manual_seed(0)
    quat = torch.nn.functional.normalize(torch.randn(4, 4, generator=generator), dim=1)
    velocity = torch.randn(4, 6, generator=generator)
    arms.set_world_poses(None, quat)
    arms.set_velocities(velocity)
    assert torch.allclose(arms.get_velocities(), velocity, atol=1e-5)
    forward(env)
    model, base = env.engine.model, env.task._arms.entity.root_body
    for row in range(4):  # MuJoCo's own velocity of the body's inertial frame
        _, data = env.world(row)
        found = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, base, found, 0)
        assert found[[3, 4, 5, 0, 1, 2]] == pytest.approx(velocity[row].numpy(), abs=1e-4)
    assert np.linalg.norm(model.body_ipos[base]) > 0.05

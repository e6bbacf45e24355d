"""Utilities of Isaac Lab that a task's own code calls: buffers, poses, interpolation."""

import math
from types import SimpleNamespace

import pytest
import torch

from rlcli.errors import TaskError
from rlcli_isaaclab import triangle_mesh
from rlcli_isaaclab.namespace import module_of
from rlcli_isaaclab.sim import SimulationCfg
from rlcli_isaaclab.utils import assets
from rlcli_isaaclab.utils.math import matrix_from_quat, quat_from_euler_xyz, random_orientation


def lab(name):
    return module_of(name, "")


def test_circular_buffer_starts_with_its_first_value():
    buffer = lab("isaaclab.utils.buffers.circular_buffer").CircularBuffer(3, 2, "cpu")
    with pytest.raises(RuntimeError, match="empty"):
        buffer[torch.zeros(2)]
    for value in range(1, 5):
        buffer.append(torch.tensor([[value], [10 * value]]))
    assert buffer.buffer[..., 0].tolist() == [[2, 3, 4], [20, 30, 40]]
    assert buffer[torch.tensor([0, 2])][:, 0].tolist() == [4, 20]
    buffer.reset([1])
    buffer.append(torch.tensor([[5], [50]]))
    assert buffer.buffer[..., 0].tolist() == [[3, 4, 5], [50, 50, 50]]
    assert buffer[torch.tensor([2, 2])][:, 0].tolist() == [3, 50]
    assert buffer.current_length.tolist() == [3, 1]


def test_delay_buffer_delays_each_environment_by_its_lag():
    buffer = lab("isaaclab.utils.buffers").DelayBuffer(2, 3, "cpu")
    buffer.set_time_lag(torch.tensor([0, 1, 2]))
    values = [buffer.compute(torch.full((3, 1), float(step)))[:, 0].tolist() for step in range(4)]
    assert values == [[0, 0, 0], [1, 0, 0], [2, 1, 0], [3, 2, 1]]
    assert (buffer.min_time_lag, buffer.max_time_lag) == (0, 2)
    with pytest.raises(ValueError, match="between 0 and 2"):
        buffer.set_time_lag(3)


def test_poses():
    maths = lab("isaaclab.utils.math")
    torch.manual_seed(0)
    rotation, position = matrix_from_quat(random_orientation(5, "cpu")), torch.rand(5, 3)
    pose = maths.make_pose(position, rotation)
    assert torch.allclose(maths.pose_inv(pose) @ pose, torch.eye(4).expand(5, 4, 4), atol=1e-5)
    assert all(torch.equal(a, b) for a, b in zip(maths.unmake_pose(pose), (position, rotation), strict=True))
    assert torch.allclose(maths.pose_in_A_to_pose_in_B(maths.pose_inv(pose), pose), torch.eye(4), atol=1e-5)
    assert maths.is_identity_pose(torch.zeros(3), torch.tensor([1.0, 0, 0, 0]))
    assert not maths.is_identity_pose(torch.ones(3), torch.tensor([1.0, 0, 0, 0]))


def test_euler_angles_are_intrinsic():
    angles = torch.tensor([[0.3, -0.5, 0.9]])
    # turns about the fixed axes x, y, z are those about the moving axes z, y, x
    expected = matrix_from_quat(quat_from_euler_xyz(*angles.unbind(1)))
    found = lab("isaaclab.utils.math").matrix_from_euler(angles.flip(1), "ZYX")
    assert torch.allclose(found, expected, atol=1e-6)


def test_interpolation_of_quaternions_takes_the_short_way():
    start, end = torch.tensor([1.0, 0, 0, 0]), -torch.tensor([math.cos(0.4), 0, 0, math.sin(0.4)])
    found = lab("isaaclab.utils.math").quat_slerp(start, end, 0.25)
    assert found.tolist() == pytest.approx([math.cos(0.1), 0, 0, math.sin(0.1)], abs=1e-6)


def test_velocities_in_another_frame():
    turned = torch.tensor([[math.sqrt(0.5), 0, 0, math.sqrt(0.5)]])  # 90 degrees about z
    velocity, spin = torch.tensor([[1.0, 0, 0]]), torch.tensor([[0, 0, 2.0]])
    found = lab("isaaclab.utils.math").rigid_body_twist_transform(velocity, spin, torch.tensor([[0, 1.0, 0]]), turned)
    assert found[0][0].tolist() == pytest.approx([0.0, 1.0, 0.0], abs=1e-6)
    assert found[1][0].tolist() == pytest.approx([0.0, 0.0, 2.0])


def test_settings_of_the_log_have_no_effect():
    assert SimulationCfg().logging_level == "WARNING"


def test_two_keys_of_one_name_are_named():
    values = {"l.*": 1.0, ".*eg": 2.0, "arm": 3.0}
    with pytest.raises(ValueError, match=r"the keys 'l\.\*' and '\.\*eg' both match 'leg'; narrow one of them"):
        lab("isaaclab.utils.string").resolve_matching_names_values(values, ["arm", "leg"])


def test_actuator_setting_with_two_values_for_a_joint_is_named():
    cfg = SimpleNamespace(stiffness={"a.*": 1.0, ".*m": 2.0})
    with pytest.raises(ValueError, match=r"setting 'stiffness' of an actuator: the keys 'a\.\*' and '\.\*m' both"):
        lab("isaaclab.actuators").IdealPDActuator(cfg, ["arm"], [0], 1, "cpu")


def test_mesh_without_the_library_trimesh():
    corners = [[x, y, z] for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)]
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    box = triangle_mesh.Trimesh(corners, [face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))])
    assert (box.volume, box.area, box.extents.tolist()) == (pytest.approx(6.0), pytest.approx(22.0), [1.0, 2.0, 3.0])
    with pytest.raises(
        TaskError, match=r"trimesh\.Trimesh\.is_watertight cannot be used: the library is not installed"
    ):
        _ = box.is_watertight


def test_local_file_is_read_and_a_missing_one_is_named(tmp_path):
    file = tmp_path / "gains.bin"
    file.write_bytes(b"gains")
    assert assets.read_file(str(file)).read() == b"gains"
    assert (assets.check_file_path(str(file)), assets.check_file_path("nucleus/robot.usd")) == (1, 2)
    with pytest.raises(TaskError, match=r"the file '.*other\.bin' does not exist"):
        assets.read_file(str(tmp_path / "other.bin"))
    with pytest.raises(TaskError, match="on a server, and rlcli downloads nothing"):
        assets.read_file(f"{assets.ISAACLAB_NUCLEUS_DIR}/gains.bin")

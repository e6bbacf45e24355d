"""Torch functions that tasks import."""

import math
import warnings

import pytest
import torch

import rlcli_oige as oige
from rlcli_oige import (
    compute_heading_and_up,
    compute_rot,
    get_euler_xyz,
    quat_axis,
    quat_diff_rad,
    quat_from_angle_axis,
    quat_from_euler_xyz,
    quat_mul,
    quat_rotate,
    quat_rotate_inverse,
    quats_to_rot_matrices,
    rot_matrices_to_quats,
    scale,
    slerp,
    tensor_clamp,
    tf_combine,
    tf_inverse,
    torch_rand_float,
    unscale,
)
from rlcli_oige.vocabulary import NAMES

HALF = math.sqrt(0.5)
QUARTER_Z = torch.tensor([[HALF, 0.0, 0.0, HALF]])  # x -> y, y -> -x
X, Y, Z = (torch.eye(3)[i : i + 1] for i in range(3))


def quats(count=50):
    return torch.nn.functional.normalize(torch.randn(count, 4, generator=torch.Generator().manual_seed(1)), dim=1)


def close(left, right):
    return torch.allclose(left, right, atol=1e-5)


def test_quarter_turn_around_z_rotates_x_to_y():
    assert close(quat_rotate(QUARTER_Z, X), Y)
    assert close(quat_rotate_inverse(QUARTER_Z, Y), X)
    assert close(quat_axis(QUARTER_Z, 1), -X)
    assert close(quat_from_angle_axis(torch.tensor([math.pi / 2]), Z), QUARTER_Z)
    assert close(quat_mul(QUARTER_Z, QUARTER_Z), torch.tensor([[0.0, 0.0, 0.0, 1.0]]))
    assert close(quats_to_rot_matrices(QUARTER_Z)[0], torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]))


@pytest.mark.parametrize("extrinsic", [True, False])
def test_euler_matrix_quaternion_round_trip(extrinsic):
    q = quats()
    assert quat_diff_rad(rot_matrices_to_quats(quats_to_rot_matrices(q)), q).max() < 1e-3
    assert quat_diff_rad(quat_from_euler_xyz(*get_euler_xyz(q, extrinsic), extrinsic), q).max() < 1e-3


def test_extrinsic_euler_rolls_first_and_intrinsic_last():
    roll, pitch, yaw = (torch.tensor([a]) for a in (math.pi / 2, 0.0, math.pi / 2))
    assert close(quat_rotate(quat_from_euler_xyz(roll, pitch, yaw), Y), Z)  # y -> z, unchanged by yaw
    assert close(quat_rotate(quat_from_euler_xyz(roll, pitch, yaw, False), Y), -X)  # y -> -x, unchanged by roll


def test_frames_combine_and_invert():
    q, t = quats(), torch.randn(50, 3)
    back = tf_combine(q, t, *tf_inverse(q, t))
    assert quat_diff_rad(back[0], torch.tensor([[1.0, 0, 0, 0]]).repeat(50, 1)).max() < 1e-3
    assert back[1].abs().max() < 1e-5


def test_slerp_takes_shorter_path():
    half = slerp(torch.tensor([[1.0, 0, 0, 0]]), -QUARTER_Z, torch.tensor([0.5]))
    assert close(half, quat_from_angle_axis(torch.tensor([math.pi / 4]), Z))


def test_scale_and_clamp():
    low, high = torch.tensor([-1.0, 2.0]), torch.tensor([3.0, 4.0])
    assert unscale(torch.tensor([[1.0, 2.0]]), low, high).tolist() == [[0.0, -1.0]]
    assert scale(torch.tensor([[0.0, -1.0]]), low, high).tolist() == [[1.0, 2.0]]
    assert tensor_clamp(torch.tensor([[-5.0, 5.0]]), low, high).tolist() == [[-1.0, 4.0]]
    drawn = torch_rand_float(-2.0, -1.0, (100, 3), "cpu")
    assert drawn.shape == (100, 3)
    assert (drawn >= -2.0).all()
    assert (drawn < -1.0).all()


def test_heading_and_velocity_of_torso_facing_y():
    start = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    quat, up, heading, up_vec, heading_vec = compute_heading_and_up(QUARTER_Z, start, 5.0 * Y, X, Z, 2)
    assert (up.item(), heading.item()) == (pytest.approx(1.0), pytest.approx(1.0))
    assert close(up_vec, Z)
    assert close(heading_vec, Y)
    velocity, spin, _, _, yaw, ahead = compute_rot(quat, 3.0 * Y, 2.0 * X, 5.0 * Y, 0.0 * Y)
    assert close(velocity, 3.0 * X)
    assert close(spin, -2.0 * Y)
    assert yaw.item() == pytest.approx(math.pi / 2)
    assert ahead.item() == pytest.approx(0.0, abs=1e-6)


def test_torchscript_functions_can_call_them():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # torch deprecates scripting, but task files use it

        def heading(q: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
            return compute_heading_and_up(q, q, v, v, v, 2)[2] + unscale(q[:, 0], q[:, 1] - 3.0, q[:, 2] + 3.0)

        for function in (compute_rot, quat_axis, tensor_clamp, quat_from_euler_xyz, get_euler_xyz, slerp):
            torch.jit.script(function)
        scripted = torch.jit.script(heading)
    q = quats()
    assert torch.allclose(scripted(q, q[:, 1:]), heading(q, q[:, 1:]))


def test_every_exported_name_exists():
    assert all(hasattr(oige, name) for name in NAMES)
    with pytest.raises(ImportError, match="cannot import name 'quat_rotat'"):
        exec("from rlcli_oige import quat_rotat")

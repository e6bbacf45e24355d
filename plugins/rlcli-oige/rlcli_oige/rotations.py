"""Functions on quaternions (w, x, y, z), named as Isaac Sim's torch utilities. TorchScript can compile all of them."""

import math

import torch
from torch import Tensor

from rlcli_oige.maths import normalize, normalize_angle


def quat_mul(a: Tensor, b: Tensor) -> Tensor:
    """Return the Hamilton product: the rotation b followed by the rotation a. (..., 4) each"""
    aw, ax, ay, az = a[..., 0], a[..., 1], a[..., 2], a[..., 3]
    bw, bx, by, bz = b[..., 0], b[..., 1], b[..., 2], b[..., 3]
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        dim=-1,
    )


def quat_conjugate(a: Tensor) -> Tensor:
    """Return the inverse of a unit quaternion. (..., 4)"""
    return torch.cat((a[..., :1], -a[..., 1:]), dim=-1)


def quat_unit(a: Tensor) -> Tensor:
    """Return quaternions scaled to length 1. (..., 4)"""
    return normalize(a)


def quat_rotate(q: Tensor, v: Tensor) -> Tensor:
    """Return v, given in the frame of the orientation q, in the parent frame. (n, 4), (n, 3) -> (n, 3)"""
    axis = q[..., 1:]
    twice = 2.0 * torch.cross(axis, v, dim=-1)
    return v + q[..., :1] * twice + torch.cross(axis, twice, dim=-1)


def quat_apply(a: Tensor, b: Tensor) -> Tensor:
    """Return the vectors b rotated by the quaternions a, in the shape of b. (..., 4), (..., 3) -> (..., 3)"""
    return quat_rotate(a.reshape(-1, 4), b.reshape(-1, 3)).reshape(b.shape)


def quat_rotate_inverse(q: Tensor, v: Tensor) -> Tensor:
    """Return v, given in the parent frame, in the frame of the orientation q. (n, 4), (n, 3) -> (n, 3)"""
    return quat_rotate(quat_conjugate(q), v)


def quat_axis(q: Tensor, axis: int = 0) -> Tensor:
    """Return the axis with the number `axis` (0: x) of an orientation's frame, in the parent frame. (n, 4) -> (n, 3)"""
    basis = torch.zeros(q.shape[0], 3, device=q.device)
    basis[:, axis] = 1.0
    return quat_rotate(q, basis)


def quat_from_angle_axis(angle: Tensor, axis: Tensor) -> Tensor:
    """Return the rotation by an angle [rad] around an axis. (n,), (n, 3) -> (n, 4)"""
    half = (angle / 2.0).unsqueeze(-1)
    return normalize(torch.cat([half.cos(), normalize(axis) * half.sin()], dim=-1))


def quat_angle_axis(x: Tensor) -> tuple[Tensor, Tensor]:
    """Return angle [rad] and axis of a rotation. (n, 4) -> (n,), (n, 3)"""
    angle = 2.0 * torch.acos(x[..., 0].clamp(-1.0, 1.0))
    axis = x[..., 1:]
    return angle, axis / axis.norm(p=2, dim=-1, keepdim=True).clamp(min=1e-9)


def quat_to_angle_axis(q: Tensor) -> tuple[Tensor, Tensor]:
    """Return the angle in [-pi, pi] [rad] and the axis of a rotation. (n, 4) -> (n,), (n, 3)"""
    angle, axis = quat_angle_axis(q)
    return normalize_angle(angle), axis


def quat_diff_rad(a: Tensor, b: Tensor) -> Tensor:
    """Return the angle between two orientations [rad]. (n,)"""
    difference = quat_mul(a, quat_conjugate(b))
    return 2.0 * torch.asin(torch.clamp(torch.norm(difference[..., 1:], p=2, dim=-1), max=1.0))


def get_euler_xyz(q: Tensor, extrinsic: bool = True) -> tuple[Tensor, Tensor, Tensor]:
    """Return roll, pitch and yaw in [0, 2 pi) [rad]. (n, 4) -> (n,) each

    With `extrinsic` the angles are around fixed axes, otherwise around moving axes.
    """
    w, x, y, z = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    if extrinsic:
        roll = torch.atan2(2.0 * (w * x + y * z), w * w - x * x - y * y + z * z)
        pitch = torch.asin((2.0 * (w * y - z * x)).clamp(-1.0, 1.0))
        yaw = torch.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
    else:
        roll = torch.atan2(2.0 * (w * x - y * z), w * w - x * x - y * y + z * z)
        pitch = torch.asin((2.0 * (w * y + z * x)).clamp(-1.0, 1.0))
        yaw = torch.atan2(2.0 * (w * z - x * y), w * w + x * x - y * y - z * z)
    turn = 2.0 * math.pi
    return roll % turn, pitch % turn, yaw % turn


def quat_from_euler_xyz(roll: Tensor, pitch: Tensor, yaw: Tensor, extrinsic: bool = True) -> Tensor:
    """Return the quaternions of rotations around x, y and z [rad]. (n,) each -> (n, 4)

    With `extrinsic` the angles are around fixed axes, otherwise around moving axes.
    """
    zero = torch.zeros_like(roll)
    qx = torch.stack([torch.cos(roll / 2.0), torch.sin(roll / 2.0), zero, zero], dim=-1)
    qy = torch.stack([torch.cos(pitch / 2.0), zero, torch.sin(pitch / 2.0), zero], dim=-1)
    qz = torch.stack([torch.cos(yaw / 2.0), zero, zero, torch.sin(yaw / 2.0)], dim=-1)
    if extrinsic:
        return quat_mul(qz, quat_mul(qy, qx))
    return quat_mul(qx, quat_mul(qy, qz))


def euler_angles_to_quats(
    euler_angles: Tensor, degrees: bool = False, extrinsic: bool = True, device: str = ""
) -> Tensor:
    """Convert angles around x, y and z [rad or degrees] to quaternions. (n, 3) -> (n, 4)"""
    angles = euler_angles * (math.pi / 180.0) if degrees else euler_angles
    return quat_from_euler_xyz(angles[:, 0], angles[:, 1], angles[:, 2], extrinsic)


def quats_to_rot_matrices(quats: Tensor, device: str = "") -> Tensor:
    """Return rotation matrices. (n, 4) -> (n, 3, 3)"""
    flat = quats.reshape(-1, 4)
    columns = torch.stack([quat_axis(flat, 0), quat_axis(flat, 1), quat_axis(flat, 2)], dim=-1)
    return columns.reshape(quats.shape[:-1] + (3, 3))  # noqa: RUF005  (TorchScript)


def rot_matrices_to_quats(rotation_matrices: Tensor, device: str = "") -> Tensor:
    """Return the quaternions of rotation matrices, with w >= 0. (n, 3, 3) -> (n, 4)"""
    m = rotation_matrices.reshape(-1, 3, 3)
    a, b, c = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    # four times the squares of w, x, y, z; dividing by the largest one avoids a division by about 0
    squares = torch.stack([1.0 + a + b + c, 1.0 + a - b - c, 1.0 - a + b - c, 1.0 - a - b + c], dim=-1)
    x, y, z = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    xy, xz, yz = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    rows = torch.stack(
        [
            torch.stack([squares[:, 0], x, y, z], dim=-1),
            torch.stack([x, squares[:, 1], xy, xz], dim=-1),
            torch.stack([y, xy, squares[:, 2], yz], dim=-1),
            torch.stack([z, xz, yz, squares[:, 3]], dim=-1),
        ],
        dim=1,
    )
    best = squares.argmax(dim=-1)
    quats = normalize(rows[torch.arange(len(best), device=m.device), best])
    quats = torch.where(quats[:, :1] < 0.0, -quats, quats)
    return quats.reshape(rotation_matrices.shape[:-2] + (4,))  # noqa: RUF005  (TorchScript)


def matrix_to_quaternion(matrix: Tensor) -> Tensor:
    """Return the quaternions of rotation matrices, with w >= 0, as `rot_matrices_to_quats` does. (n, 3, 3) -> (n, 4)"""
    return rot_matrices_to_quats(matrix)


def xyzw2wxyz(q: Tensor, ret_torch: bool = True) -> Tensor:
    """Return quaternions in the order (w, x, y, z) for quaternions in the order (x, y, z, w). (..., 4)"""
    return torch.roll(q, 1, -1)


def wxyz2xyzw(q: Tensor, ret_torch: bool = True) -> Tensor:
    """Return quaternions in the order (x, y, z, w) for quaternions in the order (w, x, y, z). (..., 4)"""
    return torch.roll(q, -1, -1)


def slerp(q0: Tensor, q1: Tensor, fraction: Tensor) -> Tensor:
    """Return the orientation at `fraction` (0 to 1) of the shorter path from q0 to q1. (n, 4), (n, 4), (n,) -> (n, 4)

    `fraction` may also have the shape (n, 1).
    """
    t = fraction.reshape(-1, 1)
    cosine = (q0 * q1).sum(dim=-1, keepdim=True)
    q1 = torch.where(cosine < 0.0, -q1, q1)
    angle = torch.acos(cosine.abs().clamp(max=1.0))
    sine = torch.sin(angle)
    near = sine < 1e-6
    safe = torch.where(near, torch.ones_like(sine), sine)
    first = torch.where(near, 1.0 - t, torch.sin((1.0 - t) * angle) / safe)
    second = torch.where(near, t, torch.sin(t * angle) / safe)
    return normalize(first * q0 + second * q1)


def tf_inverse(q: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Return the inverse of a pose with the rotation q and the translation t. (..., 4), (..., 3)"""
    inverse = quat_conjugate(q)
    return inverse, -quat_rotate(inverse, t)


def tf_apply(q: Tensor, t: Tensor, v: Tensor) -> Tensor:
    """Return the point v, rotated by the quaternion q and moved by the vector t. (n, 4), (n, 3), (n, 3) -> (n, 3)"""
    return quat_rotate(q, v) + t


def tf_vector(q: Tensor, v: Tensor) -> Tensor:
    """Return the vector v, rotated by the quaternion q. (n, 4), (n, 3) -> (n, 3)"""
    return quat_rotate(q, v)


def tf_combine(q1: Tensor, t1: Tensor, q2: Tensor, t2: Tensor) -> tuple[Tensor, Tensor]:
    """Return the transform (q2, t2) followed by the transform (q1, t1). (n, 4), (n, 3) each"""
    return quat_mul(q1, q2), quat_rotate(q1, t2) + t1


def get_basis_vector(q: Tensor, v: Tensor) -> Tensor:
    """Return the vector v rotated by the quaternion q, as `quat_rotate` does. (n, 4), (n, 3) -> (n, 3)"""
    return quat_rotate(q, v)


def get_axis_params(value, axis_idx: int, x_value=0.0, dtype=float, n_dims: int = 3) -> list:
    """Return a list of `n_dims` numbers: `value` at the index `axis_idx`, else `x_value` at 0, and 0 elsewhere."""
    params = [dtype(0.0)] * n_dims
    params[0] = dtype(x_value)
    params[axis_idx] = dtype(value)
    return params


def angle_axis_to_exp_map(angle: Tensor, axis: Tensor) -> Tensor:
    """Return the rotation vector, the axis times the angle [rad]. (n,), (n, 3) -> (n, 3)"""
    return angle.unsqueeze(-1) * axis


def quat_to_exp_map(q: Tensor) -> Tensor:
    """Return the rotation vector of a quaternion, its axis times its angle [rad]. (n, 4) -> (n, 3)"""
    angle, axis = quat_to_angle_axis(q)
    return angle_axis_to_exp_map(angle, axis)


def exp_map_to_quat(exp_map: Tensor) -> Tensor:
    """Return the quaternion of a rotation vector, an axis times an angle [rad]. (n, 3) -> (n, 4)"""
    angle = torch.norm(exp_map, p=2, dim=-1)
    return quat_from_angle_axis(angle, exp_map)


def compute_heading_and_up(
    torso_rotation: Tensor, inv_start_rot: Tensor, to_target: Tensor, vec0: Tensor, vec1: Tensor, up_idx: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return how upright a torso is, and how well it faces a target.

    Returns:
        Orientation relative to the start (n, 4); component `up_idx` of the up axis (n,); the cosine between heading and
            direction to the target (n,); the up axis (n, 3); the heading (n, 3).
    """
    torso_quat = quat_mul(torso_rotation, inv_start_rot)
    up_vec = quat_rotate(torso_quat, vec1)
    heading_vec = quat_rotate(torso_quat, vec0)
    heading_proj = (heading_vec * normalize(to_target)).sum(dim=-1)
    return torso_quat, up_vec[:, up_idx], heading_proj, up_vec, heading_vec


def compute_rot(
    torso_quat: Tensor, velocity: Tensor, ang_velocity: Tensor, targets: Tensor, torso_positions: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return a torso's velocities, angles, and the angle to a target.

    Returns:
        Linear and angular velocity in the torso's frame (n, 3) each; roll, pitch and yaw in [0, 2 pi) [rad] (n,) each;
        the direction to the target minus the yaw [rad] (n,).
    """
    vel_loc = quat_rotate_inverse(torso_quat, velocity)
    angvel_loc = quat_rotate_inverse(torso_quat, ang_velocity)
    roll, pitch, yaw = get_euler_xyz(torso_quat)
    ahead = torch.atan2(targets[:, 1] - torso_positions[:, 1], targets[:, 0] - torso_positions[:, 0])
    return vel_loc, angvel_loc, roll, pitch, yaw, ahead - yaw


ROTATION_NAMES = [
    "quat_mul", "quat_conjugate", "quat_unit", "quat_rotate", "quat_apply", "quat_rotate_inverse", "quat_axis",
    "quat_from_angle_axis", "quat_angle_axis", "quat_to_angle_axis", "quat_diff_rad", "get_euler_xyz",
    "quat_from_euler_xyz", "euler_angles_to_quats", "quats_to_rot_matrices", "rot_matrices_to_quats",
    "matrix_to_quaternion", "xyzw2wxyz", "wxyz2xyzw", "slerp", "tf_inverse", "tf_apply", "tf_vector", "tf_combine",
    "get_basis_vector", "get_axis_params", "angle_axis_to_exp_map", "quat_to_exp_map", "exp_map_to_quat",
    "compute_heading_and_up", "compute_rot",
]  # fmt: skip
"""Names of this module that `from rlcli_oige import *` exports."""

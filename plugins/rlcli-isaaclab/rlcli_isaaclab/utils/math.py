"""Rotations (w, x, y, z), angles and random samples.

A task of Isaac Lab that imports a name from `isaaclab.utils.math` gets the object of this name from here.

`sample_*` draw from torch's global generator. Unlike the samples of rlcli's events, they depend on the number of
environments.
"""

from __future__ import annotations

import inspect
from typing import Any

import torch
from torch import Tensor

from rlcli.sim.rotations import from_euler, multiply

quat_from_euler_xyz = from_euler


def quat_mul(q1: Tensor, q2: Tensor) -> Tensor:
    """Return the rotation q2 followed by the rotation q1. (..., 4) each"""
    return multiply(q1, q2)


def wrap_to_pi(angles: Tensor) -> Tensor:
    """Return the same angles in [-pi, pi] [rad]; odd multiples of pi keep their sign."""
    turns = (angles.abs() / (2.0 * torch.pi) - 0.5).ceil()
    return angles - (turns * (2.0 * torch.pi)).copysign(angles)


def quat_apply(quat: Tensor, vec: Tensor) -> Tensor:
    """Return `vec` rotated by `quat`. (..., 4), (..., 3) -> (..., 3)"""
    axis = quat[..., 1:]
    twice = 2.0 * torch.linalg.cross(axis, vec, dim=-1)
    return vec + quat[..., :1] * twice + torch.linalg.cross(axis, twice, dim=-1)


def quat_apply_inverse(quat: Tensor, vec: Tensor) -> Tensor:
    """Return `vec` rotated by the inverse of `quat`. (..., 4), (..., 3) -> (..., 3)"""
    axis = quat[..., 1:]
    twice = 2.0 * torch.linalg.cross(axis, vec, dim=-1)
    return vec - quat[..., :1] * twice + torch.linalg.cross(axis, twice, dim=-1)


def quat_rotate(q: Tensor, v: Tensor) -> Tensor:
    """Return `v` rotated by `q`, as `quat_apply` does. (..., 4), (..., 3) -> (..., 3)"""
    return quat_apply(q, v)


def quat_rotate_inverse(q: Tensor, v: Tensor) -> Tensor:
    """Return `v` rotated by the inverse of `q`, as `quat_apply_inverse` does. (..., 4), (..., 3) -> (..., 3)"""
    return quat_apply_inverse(q, v)


def quat_conjugate(q: Tensor) -> Tensor:
    """Return the inverse of a unit quaternion. (..., 4)"""
    return torch.cat([q[..., :1], -q[..., 1:]], dim=-1)


def quat_inv(q: Tensor, eps: float = 1e-9) -> Tensor:
    """Return the inverse of a quaternion of any length. (..., 4)"""
    return quat_conjugate(q) / q.square().sum(dim=-1, keepdim=True).clamp(min=eps)


def yaw_quat(quat: Tensor) -> Tensor:
    """Return the yaw of a rotation as a rotation around z. (..., 4)"""
    w, x, y, z = quat.unbind(-1)
    yaw = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    zero = torch.zeros_like(yaw)
    return torch.stack([torch.cos(0.5 * yaw), zero, zero, torch.sin(0.5 * yaw)], dim=-1)


def quat_apply_yaw(quat: Tensor, vec: Tensor) -> Tensor:
    """Return `vec` rotated by the yaw of `quat` alone. (..., 4), (..., 3) -> (..., 3)"""
    return quat_apply(yaw_quat(quat), vec)


def euler_xyz_from_quat(quat: Tensor, wrap_to_2pi: bool = False) -> tuple[Tensor, Tensor, Tensor]:
    """Return roll, pitch and yaw [rad] in [-pi, pi], or in [0, 2 pi). (n, 4) -> (n,) each"""
    w, x, y, z = quat.unbind(-1)
    roll = torch.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = torch.asin((2.0 * (w * y - z * x)).clamp(-1.0, 1.0))
    yaw = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    if wrap_to_2pi:
        return roll % (2.0 * torch.pi), pitch % (2.0 * torch.pi), yaw % (2.0 * torch.pi)
    return roll, pitch, yaw


def quat_unique(q: Tensor) -> Tensor:
    """Return the same rotation with w >= 0. (..., 4)"""
    return torch.where(q[..., :1] < 0, -q, q)


def quat_error_magnitude(q1: Tensor, q2: Tensor) -> Tensor:
    """Return the angle between two rotations [rad]. (..., 4) each -> (...)"""
    return quat_box_minus(q1, q2).norm(p=2, dim=-1)  # exact for small angles, unlike the arc cosine of q1 * q2


def subtract_frame_transforms(
    t01: Tensor, q01: Tensor, t02: Tensor | None = None, q02: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return the pose of frame 2 relative to frame 1, from the poses of both relative to frame 0.

    A position t (n, 3) [m] and a quaternion q (n, 4) each; None: zero, or no rotation.
    """
    back = quat_conjugate(q01)
    quat = back if q02 is None else multiply(back, q02)
    return quat_apply(back, -t01 if t02 is None else t02 - t01), quat


def combine_frame_transforms(
    t01: Tensor, q01: Tensor, t12: Tensor | None = None, q12: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return the pose of frame 2 relative to frame 0, from frame 1 relative to 0 and frame 2 relative to 1.

    A position t (n, 3) [m] and a quaternion q (n, 4) each; None: zero, or no rotation.
    """
    quat = q01 if q12 is None else multiply(q01, q12)
    return t01 if t12 is None else t01 + quat_apply(q01, t12), quat


def normalize(x: Tensor, eps: float = 1e-9) -> Tensor:
    """Return vectors scaled to length 1; a vector of length 0 stays 0. (..., n)"""
    return x / x.norm(p=2, dim=-1, keepdim=True).clamp(min=eps)


def scale_transform(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return x mapped linearly from [lower, upper] to [-1, 1], in the shape of x."""
    return 2.0 * (x - 0.5 * (lower + upper)) / (upper - lower)


def unscale_transform(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return x mapped linearly from [-1, 1] to [lower, upper], in the shape of x."""
    return 0.5 * (x * (upper - lower) + upper + lower)


def saturate(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return x clamped to [lower, upper], in the shape of x."""
    return torch.maximum(torch.minimum(x, upper), lower)


def copysign(mag: float, other: Tensor) -> Tensor:
    """Return a tensor with the magnitude `mag` everywhere and the signs of `other`."""
    return torch.full_like(other, abs(mag)).copysign(other)


def quat_from_angle_axis(angle: Tensor, axis: Tensor) -> Tensor:
    """Return the rotation by an angle [rad] around an axis of any length. (n,), (n, 3) -> (n, 4)"""
    unit = axis / axis.norm(p=2, dim=-1, keepdim=True).clamp(min=1e-9)
    half = (0.5 * angle).unsqueeze(-1)
    return torch.cat([half.cos(), unit * half.sin()], dim=-1)


def axis_angle_from_quat(quat: Tensor, eps: float = 1.0e-6) -> Tensor:
    """Return a rotation as its axis times its angle [rad]. (..., 4) -> (..., 3)

    The quaternions must have length 1; any other length is a factor of the result, as in Isaac Lab.
    """
    quat = torch.where(quat[..., :1] < 0.0, -quat, quat)
    half = torch.atan2(quat[..., 1:].norm(p=2, dim=-1, keepdim=True), quat[..., :1])
    small = half.abs() < 0.5 * eps
    # the sine of the angle, not the length of the axis: a quaternion that is not normalised scales the result
    return quat[..., 1:] * torch.where(small, 2.0, 2.0 * half / torch.where(small, 1.0, half.sin()))


def matrix_from_quat(quaternions: Tensor) -> Tensor:
    """Return rotation matrices. (..., 4) -> (..., 3, 3)"""
    w, x, y, z = quaternions.unbind(-1)
    twice = 2.0 / (quaternions * quaternions).sum(-1)
    first = torch.stack([1.0 - twice * (y * y + z * z), twice * (x * y - z * w), twice * (x * z + y * w)], dim=-1)
    second = torch.stack([twice * (x * y + z * w), 1.0 - twice * (x * x + z * z), twice * (y * z - x * w)], dim=-1)
    third = torch.stack([twice * (x * z - y * w), twice * (y * z + x * w), 1.0 - twice * (x * x + y * y)], dim=-1)
    return torch.stack([first, second, third], dim=-2)


def quat_from_matrix(matrix: Tensor) -> Tensor:
    """Return the quaternions of rotation matrices, the largest number positive. (..., 3, 3) -> (..., 4)"""
    m = matrix.reshape(-1, 3, 3)
    a, b, c = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    squares = torch.stack([1 + a + b + c, 1 + a - b - c, 1 - a + b - c, 1 - a - b + c], dim=1)
    wx, wy, wz = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    xy, xz, yz = m[:, 1, 0] + m[:, 0, 1], m[:, 0, 2] + m[:, 2, 0], m[:, 2, 1] + m[:, 1, 2]
    rows = [
        [squares[:, 0], wx, wy, wz],
        [wx, squares[:, 1], xy, xz],
        [wy, xy, squares[:, 2], yz],
        [wz, xz, yz, squares[:, 3]],
    ]
    table = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
    best = table[torch.arange(len(m), device=m.device), squares.argmax(dim=1)]  # the largest divisor is the most exact
    return normalize(best).reshape(list(matrix.shape[:-2]) + [4])  # noqa: RUF005 (TorchScript)


def convert_quat(quat: Any, to: str = "xyzw") -> Any:
    """Return quaternions with the real part moved to the end (`xyzw`) or to the start (`wxyz`). (..., 4)"""
    order = [1, 2, 3, 0] if to == "xyzw" else [3, 0, 1, 2]
    return quat[..., order]


def quat_box_minus(q1: Tensor, q2: Tensor) -> Tensor:
    """Return the rotation from q2 to q1 as its axis times its angle [rad]. (n, 4) each -> (n, 3)"""
    return axis_angle_from_quat(multiply(q1, quat_conjugate(q2)))


def quat_box_plus(q: Tensor, delta: Tensor, eps: float = 1.0e-6) -> Tensor:
    """Return the rotation q followed by `delta` (axis times angle [rad]), with w >= 0. (n, 4), (n, 3) -> (n, 4)"""
    return quat_unique(multiply(quat_from_angle_axis(delta.norm(p=2, dim=-1), delta), q))


def compute_pose_error(
    t01: Tensor, q01: Tensor, t02: Tensor, q02: Tensor, rot_error_type: str = "axis_angle"
) -> tuple[Tensor, Tensor]:
    """Return the difference in position [m] and the rotation from pose 1 to pose 2.

    The rotation is its axis times its angle (n, 3) [rad], or with `rot_error_type="quat"` a quaternion (n, 4).
    """
    turn = multiply(q02, quat_conjugate(q01) / q01.square().sum(dim=-1, keepdim=True))
    return t02 - t01, turn if rot_error_type == "quat" else axis_angle_from_quat(turn)


def apply_delta_pose(source_pos: Tensor, source_rot: Tensor, delta_pose: Tensor, eps: float = 1.0e-6) -> Any:
    """Return (position (n, 3), quaternion (n, 4)) of a pose moved by `delta_pose` (n, 6).

    `delta_pose` is a translation [m] and a rotation, its axis times its angle [rad], both in the frame of the pose's
    coordinates.
    """
    turn = quat_from_angle_axis(delta_pose[:, 3:6].norm(p=2, dim=-1), delta_pose[:, 3:6])
    return source_pos + delta_pose[:, :3], multiply(turn, source_rot)


def transform_points(points: Tensor, pos: Tensor | None = None, quat: Tensor | None = None) -> Tensor:
    """Return points rotated and then translated, in the shape of `points`, or (n, p, 3) for several transformations.

    Args:
        points: (n, p, 3), or (p, 3) for one set of points.
        pos: translations (n, 3) or one (3,) [m]; None: none.
        quat: rotations (n, 4) or one (4,); None: none.
    """
    moved = points if points.dim() == 3 else points.unsqueeze(0)
    if quat is not None:
        moved = moved @ matrix_from_quat(quat.reshape(-1, 4)).transpose(1, 2)
    if pos is not None:
        moved = moved + pos.reshape(-1, 1, 3)
    return moved if points.dim() == 3 else moved.squeeze(0)


def skew_symmetric_matrix(vec: Tensor) -> Tensor:
    """Return the matrix S for which S w is the cross product of `vec` and w. (..., 3) -> (..., 3, 3)"""
    x, y, z = vec.unbind(-1)
    zero = torch.zeros_like(x)
    first, second = torch.stack([zero, -z, y], dim=-1), torch.stack([z, zero, -x], dim=-1)
    return torch.stack([first, second, torch.stack([-y, x, zero], dim=-1)], dim=-2)


def default_orientation(num: int, device: str) -> Tensor:
    """Return identity quaternions (1, 0, 0, 0). (num, 4)"""
    return torch.eye(1, 4, device=device).repeat(num, 1)


def random_yaw_orientation(num: int, device: str) -> Tensor:
    """Sample rotations around z uniformly. (num, 4)"""
    yaw = torch.rand(num, device=device) * 2.0 * torch.pi
    return from_euler(torch.zeros_like(yaw), torch.zeros_like(yaw), yaw)


def sample_triangle(lower: float, upper: float, size: Any, device: Any) -> Tensor:
    """Return samples of the shape `size` from [lower, upper]; their density grows linearly from 0 in the middle.

    Despite the name, this is what Isaac Lab's function does.
    """
    uniform = sample_uniform(-1.0, 1.0, size, device)
    return (uniform.abs().sqrt().copysign(uniform) + 1.0) * 0.5 * (upper - lower) + lower


def sample_cylinder(radius: float, h_range: tuple[float, float], size: Any, device: Any) -> Tensor:
    """Sample points on the surface of a cylinder around z, with heights in a range. (size, 3) [m]"""
    angle = sample_uniform(-torch.pi, torch.pi, size, device)
    return torch.stack([radius * angle.cos(), radius * angle.sin(), sample_uniform(*h_range, size, device)], dim=-1)


def orthogonalize_perspective_depth(depth: Tensor, intrinsics: Tensor) -> Tensor:
    """Convert distances to the camera into distances along its optical axis. (n, h, w[, 1]), (3, 3) or (n, 3, 3)"""
    flat = depth.squeeze(-1) if depth.shape[-1] == 1 else depth
    height, width = flat.shape[-2:]
    inverse = intrinsics.reshape(-1, 3, 3)
    rows = torch.arange(height, device=depth.device).float()[:, None]
    columns = torch.arange(width, device=depth.device).float()
    x = (columns - inverse[:, 0, 2, None, None]) / inverse[:, 0, 0, None, None]
    y = (rows - inverse[:, 1, 2, None, None]) / inverse[:, 1, 1, None, None]
    return (flat / (1.0 + x.square() + y.square()).sqrt()).reshape(depth.shape)


def sample_uniform(lower: Any, upper: Any, size: Any, device: Any) -> Tensor:
    """Return uniform samples from [lower, upper), of the shape `size`."""
    shape = (size,) if isinstance(size, int) else tuple(size)
    return torch.rand(*shape, device=device) * (upper - lower) + lower


def sample_gaussian(mean: Any, std: Any, size: Any, device: Any) -> Tensor:
    """Return samples from a normal distribution, of the shape `size`."""
    shape = (size,) if isinstance(size, int) else tuple(size)
    return torch.randn(*shape, device=device) * std + mean


def sample_log_uniform(lower: Any, upper: Any, size: Any, device: Any) -> Tensor:
    """Return log-uniform samples from [lower, upper), of the shape `size`."""
    low, high = (torch.as_tensor(end, device=device, dtype=torch.float32).log() for end in (lower, upper))
    return sample_uniform(low, high, size, device).exp()


def random_orientation(num: int, device: str) -> Tensor:
    """Sample rotations uniformly. (num, 4)"""
    return normalize(torch.randn(num, 4, device=device))


__all__ = [name for name, value in dict(globals()).items() if inspect.isfunction(value) and not name.startswith("_")]

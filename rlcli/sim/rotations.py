"""Rotations of vectors by unit quaternions (w, x, y, z), and angles, on (n, ...) tensors.

Every function gives the same bits for a row whatever the number of rows: only arithmetic that torch rounds alike in
its vectorised and its scalar loops is used (so no atan2 and no pow).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

cross: Callable[[Tensor, Tensor], Tensor] = torch.linalg.cross
"""Cross product; torch leaves its function without types. (..., 3), (..., 3) -> (..., 3)"""


def rotate(quat: Tensor, vector: Tensor) -> Tensor:
    """Vector in the parent frame of a vector given in the quaternion's frame. (..., 4), (..., 3) -> (..., 3)"""
    w, axis = quat[..., :1], quat[..., 1:]
    twice = 2.0 * cross(axis, vector)
    return vector + w * twice + cross(axis, twice)


def rotate_inverse(quat: Tensor, vector: Tensor) -> Tensor:
    """Vector in the quaternion's frame of a vector given in the parent frame. (..., 4), (..., 3) -> (..., 3)"""
    w, axis = quat[..., :1], quat[..., 1:]
    twice = 2.0 * cross(axis, vector)
    return vector - w * twice + cross(axis, twice)


def multiply(left: Tensor, right: Tensor) -> Tensor:
    """Hamilton product: first `right`, then `left`. (..., 4), (..., 4) -> (..., 4)"""
    w1, x1, y1, z1 = left.unbind(-1)
    w2, x2, y2, z2 = right.unbind(-1)
    return torch.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        dim=-1,
    )


def conjugate(quat: Tensor) -> Tensor:
    """The rotation back. (..., 4) -> (..., 4)"""
    return torch.cat([quat[..., :1], -quat[..., 1:]], dim=-1)


def unique(quat: Tensor) -> Tensor:
    """The same rotation with w >= 0. (..., 4) -> (..., 4)"""
    return torch.where(quat[..., :1] < 0.0, -quat, quat)


def axis_x(quat: Tensor) -> Tensor:
    """The quaternion's x axis in the parent frame. (..., 4) -> (..., 3)"""
    w, x, y, z = quat.unbind(-1)
    return torch.stack([1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)], dim=-1)


def axis_y(quat: Tensor) -> Tensor:
    """The quaternion's y axis in the parent frame. (..., 4) -> (..., 3)"""
    w, x, y, z = quat.unbind(-1)
    return torch.stack([2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)], dim=-1)


def axis_z(quat: Tensor) -> Tensor:
    """The quaternion's z axis in the parent frame. (..., 4) -> (..., 3)"""
    w, x, y, z = quat.unbind(-1)
    return torch.stack([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)], dim=-1)


def roll_pitch_yaw(quat: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Angles of `from_euler`: roll and yaw in [-pi, pi], pitch in [-pi/2, pi/2] [rad]. (..., 4) -> (...) each"""
    w, x, y, z = quat.unbind(-1)
    roll = atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = torch.asin((2.0 * (w * y - z * x)).clamp_(-1.0, 1.0))
    return roll, pitch, atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def turn_between(left: Tensor, right: Tensor) -> Tensor:
    """Angle of the rotation that takes one attitude to the other, in [0, pi] [rad]. (..., 4), (..., 4) -> (...)"""
    difference = multiply(conjugate(left), right)
    return 2.0 * atan2(length(difference[..., 1:]), difference[..., 0].abs())


def length(vector: Tensor) -> Tensor:
    """Euclidean length. (..., k) -> (...)"""
    return vector.square().sum(dim=-1).sqrt_()


def rotation_vector(quat: Tensor) -> Tensor:
    """Axis times angle, the angle in [0, pi] [rad]. (n, 4) -> (n, 3)"""
    w, axis = torch.where(quat[:, :1] < 0.0, -quat, quat).split_with_sizes([1, 3], dim=1)
    x, y, z = axis.unbind(1)
    sine = (x * x + y * y + z * z).sqrt()[:, None]
    angle = 2.0 * atan2(sine, w)
    return axis * torch.where(sine < 1e-6, 2.0, angle / sine.clamp(min=1e-6))  # the limit of a small angle


def from_euler(roll: Tensor, pitch: Tensor, yaw: Tensor) -> Tensor:
    """Quaternion of a rotation about x, then y, then z, all fixed axes [rad]. (n,) each -> (n, 4)"""
    cr, sr = torch.cos(0.5 * roll), torch.sin(0.5 * roll)
    cp, sp = torch.cos(0.5 * pitch), torch.sin(0.5 * pitch)
    cy, sy = torch.cos(0.5 * yaw), torch.sin(0.5 * yaw)
    return torch.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ],
        dim=-1,
    )


def random_quaternion(u: Tensor, v: Tensor, w: Tensor) -> Tensor:
    """Uniform over all rotations, from three uniform draws in [0, 1) (Shoemake 1992). (n,) each -> (n, 4)"""
    a, b = torch.sqrt(1.0 - u), torch.sqrt(u)
    v, w = 2.0 * math.pi * v, 2.0 * math.pi * w
    return torch.stack([b * torch.cos(w), a * torch.sin(v), a * torch.cos(v), b * torch.sin(w)], dim=-1)


def atan2(y: Tensor, x: Tensor) -> Tensor:
    """Angle from the x axis to the point (x, y), within 1e-6 of torch's atan2; 0 at the origin [rad]. (...) each"""
    x = x + 1e-30  # neither 0 nor -0, so that the quotient is a number at the origin too
    behind = (x < 0.0).mul(math.pi).copysign_(y)
    return torch.atan(y / x).add_(behind)


def heading(quat: Tensor) -> Tensor:
    """Angle of the x axis about the world's z axis, from its x axis, in [-pi, pi] [rad]. (n, 4) -> (n,)"""
    w, x, y, z = quat.unbind(-1)
    return atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def yaw_only(quat: Tensor) -> Tensor:
    """The turn about the world's z axis alone, towards the same heading. (n, 4) -> (n, 4)"""
    half = 0.5 * heading(quat)
    zero = torch.zeros_like(half)
    return torch.stack([torch.cos(half), zero, zero, torch.sin(half)], dim=-1)


def wrap_to_pi(angle: Tensor) -> Tensor:
    """The same angle in [-pi, pi] [rad]; one that lies there already is returned bit for bit."""
    turns = (angle * (0.5 / math.pi)).round_()
    return torch.sub(angle, turns.mul_(2.0 * math.pi))

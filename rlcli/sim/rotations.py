"""Rotations by unit quaternions (w, x, y, z), and angles, on (n, ...) tensors.

The result of a row is bit-identical for any number of rows. The functions therefore use only operations that torch
rounds equally in its vectorised and its scalar loops: no `torch.atan2` and no `pow`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import torch
from torch import Tensor

cross: Callable[..., Tensor] = torch.linalg.cross
"""Cross product: `torch.linalg.cross`, with a type annotation. (..., 3), (..., 3) -> (..., 3)"""


def rotate(quat: Tensor, vector: Tensor) -> Tensor:
    """Transform a vector from the quaternion's frame to the parent frame. (..., 4), (..., 3) -> (..., 3)"""
    w, axis = quat[..., :1], quat[..., 1:]
    twice = 2.0 * cross(axis, vector)
    return vector + w * twice + cross(axis, twice)


def rotate_inverse(quat: Tensor, vector: Tensor) -> Tensor:
    """Transform a vector from the parent frame to the quaternion's frame. (..., 4), (..., 3) -> (..., 3)"""
    w, axis = quat[..., :1], quat[..., 1:]
    twice = 2.0 * cross(axis, vector)
    return vector - w * twice + cross(axis, twice)


def multiply(left: Tensor, right: Tensor) -> Tensor:
    """Return the Hamilton product: the rotation `right` followed by `left`. (..., 4), (..., 4) -> (..., 4)"""
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
    """Return the inverse rotation. (..., 4) -> (..., 4)"""
    return torch.cat([quat[..., :1], -quat[..., 1:]], dim=-1)


def unique(quat: Tensor) -> Tensor:
    """Return the quaternion of the same rotation with w >= 0. (..., 4) -> (..., 4)"""
    return torch.where(quat[..., :1] < 0.0, -quat, quat)


def axis_x(quat: Tensor) -> Tensor:
    """Return the x axis of the quaternion's frame in the parent frame. (..., 4) -> (..., 3)"""
    w, x, y, z = quat.unbind(-1)
    return torch.stack([1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)], dim=-1)


def axis_y(quat: Tensor) -> Tensor:
    """Return the y axis of the quaternion's frame in the parent frame. (..., 4) -> (..., 3)"""
    w, x, y, z = quat.unbind(-1)
    return torch.stack([2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)], dim=-1)


def axis_z(quat: Tensor) -> Tensor:
    """Return the z axis of the quaternion's frame in the parent frame. (..., 4) -> (..., 3)"""
    w, x, y, z = quat.unbind(-1)
    return torch.stack([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)], dim=-1)


def axes(quat: Tensor) -> Tensor:
    """Return the columns of `axis_x`, `axis_y` and `axis_z` in one tensor, in a third of the time. (n, 4) -> (n, 9)"""
    factors, scales, offsets = _axis_tables(quat.device)
    left, right = quat.mT.contiguous().index_select(0, factors).chunk(2)
    first, second = (left * right).mul_(scales).chunk(2)
    return (first + second).add_(offsets).mT


@functools.lru_cache
@torch.inference_mode(False)  # tensors that can be used in both modes
def _axis_tables(device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Return the constants of `axes`, which computes each of its 9 elements as s1 a b + s2 c d + offset.

    a, b, c and d are elements of the quaternion. Return their indices (36,): all a, all c, all b, all d; the scales s1
    and s2 (18, 1); and the offsets (9, 1).
    """
    first, second = (
        ["yy", "xy", "xz", "xy", "xx", "yz", "xz", "yz", "xx"],
        ["zz", "wz", "wy", "wz", "zz", "wx", "wy", "wx", "yy"],
    )
    factors = ["wxyz".index(product[side]) for side in (0, 1) for product in first + second]
    scales = torch.tensor(
        [-2.0, 2.0, 2.0, 2.0, -2.0, 2.0, 2.0, 2.0, -2.0, -2.0, 2.0, -2.0, -2.0, -2.0, 2.0, 2.0, -2.0, -2.0]
    )
    offsets = torch.full((9,), -0.0)  # adding -0.0 keeps the sign of a zero
    offsets[::4] = 1.0
    return torch.tensor(factors, device=device), scales.to(device)[:, None], offsets.to(device)[:, None]


def roll_pitch_yaw(quat: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return roll, pitch (within +-pi/2) and yaw, the angles for `from_euler` [rad]. (..., 4) -> (...) each"""
    w, x, y, z = quat.unbind(-1)
    roll = atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = torch.asin((2.0 * (w * y - z * x)).clamp_(-1.0, 1.0))
    return roll, pitch, atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def turn_between(left: Tensor, right: Tensor) -> Tensor:
    """Return the angle of the rotation between two orientations, in [0, pi] [rad]. (..., 4), (..., 4) -> (...)"""
    difference = multiply(conjugate(left), right)
    return 2.0 * atan2(length(difference[..., 1:]), difference[..., 0].abs())


def length(vector: Tensor) -> Tensor:
    """Return the Euclidean length of a vector. (..., k) -> (...)"""
    return vector.square().sum(dim=-1).sqrt_()


def rotation_vector(quat: Tensor) -> Tensor:
    """Return the rotation vector: unit axis times angle, with the angle in [0, pi] [rad]. (n, 4) -> (n, 3)"""
    w, axis = unique(quat).split_with_sizes([1, 3], dim=1)
    x, y, z = axis.unbind(1)
    sine = (x * x + y * y + z * z).sqrt()[:, None]
    angle = 2.0 * atan2(sine, w)
    return axis * torch.where(sine < 1e-6, 2.0, angle / sine.clamp(min=1e-6))  # the limit of a small angle


def from_euler(roll: Tensor, pitch: Tensor, yaw: Tensor) -> Tensor:
    """Return the quaternion of rotations about the fixed axes x, then y, then z [rad]. (n,) each -> (n, 4)"""
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
    """Return a uniform random rotation from three uniform numbers in [0, 1) (Shoemake 1992). (n,) each -> (n, 4)"""
    a, b = torch.sqrt(1.0 - u), torch.sqrt(u)
    v, w = 2.0 * math.pi * v, 2.0 * math.pi * w
    return torch.stack([b * torch.cos(w), a * torch.sin(v), a * torch.cos(v), b * torch.sin(w)], dim=-1)


def atan2(y: Tensor, x: Tensor) -> Tensor:
    """Return the angle of the point (x, y), within 1e-6 of `torch.atan2`; 0 at the origin [rad]. (...) each"""
    x = x + 1e-30  # neither 0 nor -0, so that the quotient is finite at the origin too
    half_turn = (x < 0.0).mul(math.pi).copysign_(y)
    return torch.atan(y / x).add_(half_turn)


def heading(quat: Tensor) -> Tensor:
    """Return the yaw: the angle of the x axis about the world's z axis, in [-pi, pi] [rad]. (n, 4) -> (n,)"""
    w, x, y, z = quat.unbind(-1)
    return atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def yaw_only(quat: Tensor) -> Tensor:
    """Return the rotation about the world's z axis that has the same heading. (n, 4) -> (n, 4)"""
    half = 0.5 * heading(quat)
    zero = torch.zeros_like(half)
    return torch.stack([torch.cos(half), zero, zero, torch.sin(half)], dim=-1)


def wrap_to_pi(angle: Tensor) -> Tensor:
    """Return the same angle in [-pi, pi] [rad]; an angle in this range is returned unchanged."""
    turns = (angle * (0.5 / math.pi)).round_()
    return torch.sub(angle, turns.mul_(2.0 * math.pi))

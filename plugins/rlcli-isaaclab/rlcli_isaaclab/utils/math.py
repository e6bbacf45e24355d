"""Rotations (w, x, y, z), angles and random samples. Names as in `isaaclab.utils.math`.

`sample_*` draw from torch's global generator. Unlike the samples of rlcli's events, they depend on the number of
environments.
"""

from __future__ import annotations

import inspect
from typing import Any

import torch
from torch import Tensor

from rlcli.sim.rotations import from_euler, multiply, rotate, rotate_inverse
from rlcli.sim.rotations import wrap_to_pi as wrap_to_pi

quat_from_euler_xyz, quat_mul = from_euler, multiply


def _rows(function: Any, quat: Tensor, vector: Tensor) -> Tensor:
    quat = quat.expand(*vector.shape[:-1], 4) if quat.dim() <= vector.dim() else quat
    return function(quat.reshape(-1, 4), vector.reshape(-1, 3)).reshape(vector.shape)


def quat_apply(quat: Tensor, vec: Tensor) -> Tensor:
    """Rotate a vector. (..., 4), (..., 3) -> (..., 3)"""
    return _rows(rotate, quat, vec)


def quat_apply_inverse(quat: Tensor, vec: Tensor) -> Tensor:
    """Rotate a vector by the inverse rotation. (..., 4), (..., 3) -> (..., 3)"""
    return _rows(rotate_inverse, quat, vec)


quat_rotate, quat_rotate_inverse = quat_apply, quat_apply_inverse


def quat_conjugate(q: Tensor) -> Tensor:
    """Return the inverse of a unit quaternion. (..., 4)"""
    return torch.cat([q[..., :1], -q[..., 1:]], dim=-1)


quat_inv = quat_conjugate


def yaw_quat(quat: Tensor) -> Tensor:
    """Return only the rotation around z. (..., 4)"""
    w, x, y, z = quat.unbind(-1)
    yaw = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    zero = torch.zeros_like(yaw)
    return torch.stack([torch.cos(0.5 * yaw), zero, zero, torch.sin(0.5 * yaw)], dim=-1)


def quat_apply_yaw(quat: Tensor, vec: Tensor) -> Tensor:
    """Rotate a vector only around z. (..., 4), (..., 3) -> (..., 3)"""
    return quat_apply(yaw_quat(quat), vec)


def euler_xyz_from_quat(quat: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return roll, pitch and yaw [rad] in [0, 2 pi). (n, 4) -> (n,) each"""
    w, x, y, z = quat.unbind(-1)
    roll = torch.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = torch.asin((2.0 * (w * y - z * x)).clamp(-1.0, 1.0))
    yaw = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    turn = 2.0 * torch.pi
    return roll % turn, pitch % turn, yaw % turn


def quat_unique(q: Tensor) -> Tensor:
    """Return the same rotation with w >= 0. (..., 4)"""
    return torch.where(q[..., :1] < 0, -q, q)


def quat_error_magnitude(q1: Tensor, q2: Tensor) -> Tensor:
    """Return the angle between two rotations [rad]. (..., 4) each -> (...)"""
    cosine = (q1 * q2).sum(dim=-1).abs().clamp(max=1.0)
    return 2.0 * torch.acos(cosine)


def subtract_frame_transforms(t01: Tensor, q01: Tensor, t02: Tensor | None = None, q02: Tensor | None = None) -> Any:
    """Return the pose of frame 2 in frame 1. Both poses are given in frame 0."""
    back = quat_conjugate(q01)
    quat = back if q02 is None else multiply(back, q02)
    return quat_apply(back, -t01 if t02 is None else t02 - t01), quat


def combine_frame_transforms(t01: Tensor, q01: Tensor, t12: Tensor | None = None, q12: Tensor | None = None) -> Any:
    """Return the pose of frame 2 in frame 0, from frame 1 in frame 0 and frame 2 in frame 1."""
    quat = q01 if q12 is None else multiply(q01, q12)
    return t01 if t12 is None else t01 + quat_apply(q01, t12), quat


def normalize(x: Tensor, eps: float = 1e-9) -> Tensor:
    """Scale vectors to length 1. (..., n)"""
    return x / x.norm(dim=-1, keepdim=True).clamp(min=eps)


def scale_transform(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Map [lower, upper] to [-1, 1]."""
    return 2.0 * (x - 0.5 * (lower + upper)) / (upper - lower)


def unscale_transform(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Map [-1, 1] to [lower, upper]."""
    return 0.5 * (x * (upper - lower) + upper + lower)


def saturate(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Clamp values to [lower, upper]."""
    return torch.maximum(torch.minimum(x, upper), lower)


def copysign(mag: float, other: Tensor) -> Tensor:
    """Return a tensor of one magnitude with the signs of another tensor."""
    return torch.full_like(other, abs(mag)).copysign(other)


def sample_uniform(lower: Any, upper: Any, size: Any, device: Any) -> Tensor:
    """Sample uniformly from [lower, upper)."""
    shape = (size,) if isinstance(size, int) else tuple(size)
    return torch.rand(*shape, device=device) * (upper - lower) + lower


def sample_gaussian(mean: Any, std: Any, size: Any, device: Any) -> Tensor:
    """Sample from a normal distribution."""
    shape = (size,) if isinstance(size, int) else tuple(size)
    return torch.randn(*shape, device=device) * std + mean


def sample_log_uniform(lower: Any, upper: Any, size: Any, device: Any) -> Tensor:
    """Sample log-uniformly from [lower, upper)."""
    low, high = (torch.as_tensor(end, device=device, dtype=torch.float32).log() for end in (lower, upper))
    return sample_uniform(low, high, size, device).exp()


def random_orientation(num: int, device: Any) -> Tensor:
    """Sample rotations uniformly. (num, 4)"""
    return normalize(torch.randn(num, 4, device=device))


__all__ = [name for name, value in dict(globals()).items() if inspect.isfunction(value) and not name.startswith("_")]

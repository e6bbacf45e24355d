"""Functions of `isaacsim.core.utils.torch` that direct tasks use. Quaternions are (w, x, y, z)."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rlcli.sim.rotations import multiply as quat_mul
from rlcli.sim.rotations import roll_pitch_yaw, rotate, rotate_inverse
from rlcli_isaaclab.utils.math import normalize as normalize
from rlcli_isaaclab.utils.math import quat_conjugate as quat_conjugate
from rlcli_isaaclab.utils.math import quat_from_angle_axis as quat_from_angle_axis
from rlcli_isaaclab.utils.math import quat_from_euler_xyz as quat_from_euler_xyz

quat_rotate, quat_rotate_inverse = rotate, rotate_inverse


def quat_apply(a: Tensor, b: Tensor) -> Tensor:
    """Return the vectors b rotated by the quaternions a. (..., 4), (..., 3) -> (..., 3)"""
    return rotate(a.reshape(-1, 4), b.reshape(-1, 3)).reshape(b.shape)


def get_euler_xyz(q: Tensor, extrinsic: bool = True) -> tuple[Tensor, Tensor, Tensor]:
    """Return roll, pitch and yaw in [0, 2 pi) [rad]. (n, 4) -> (n,) each"""
    roll, pitch, yaw = roll_pitch_yaw(q)
    turn = 2.0 * torch.pi
    return roll % turn, pitch % turn, yaw % turn


def normalize_angle(x: Tensor) -> Tensor:
    """Return the same angle in [-pi, pi] [rad]."""
    return torch.atan2(torch.sin(x), torch.cos(x))


def tf_combine(q1: Tensor, t1: Tensor, q2: Tensor, t2: Tensor) -> tuple[Tensor, Tensor]:
    """Return the pose (q2, t2), given in the frame (q1, t1), in the parent frame of (q1, t1). (n, 4), (n, 3)"""
    return quat_mul(q1, q2), quat_apply(q1, t2) + t1


def tf_inverse(q: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Return the inverse of the pose (q, t): quaternion (n, 4) and position (n, 3)."""
    back = quat_conjugate(q)
    return back, -quat_apply(back, t)


def tf_apply(q: Tensor, t: Tensor, v: Tensor) -> Tensor:
    """Return the point v, rotated by the quaternion q and moved by t. (..., 4), (..., 3), (..., 3) -> (..., 3)"""
    return quat_apply(q, v) + t


def tf_vector(q: Tensor, v: Tensor) -> Tensor:
    """Return the vector v rotated by the quaternion q. (..., 4), (..., 3) -> (..., 3)"""
    return quat_apply(q, v)


def scale(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return x mapped linearly from [-1, 1] to [lower, upper], in the shape of x."""
    return 0.5 * (x + 1.0) * (upper - lower) + lower


def unscale(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return x mapped linearly from [lower, upper] to [-1, 1], in the shape of x."""
    return (2.0 * x - upper - lower) / (upper - lower)


def saturate(x: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return x clamped to [lower, upper]."""
    return torch.maximum(torch.minimum(x, upper), lower)


tensor_clamp = saturate


def torch_rand_float(lower: float, upper: float, shape: Any, device: Any) -> Tensor:
    """Return a tensor of this shape with uniform samples from [lower, upper)."""
    return (upper - lower) * torch.rand(*shape, device=device) + lower


def to_torch(x: Any, dtype: torch.dtype = torch.float, device: Any = "cpu", requires_grad: bool = False) -> Tensor:
    """Return a number, list or array as a new tensor."""
    return torch.tensor(np.asarray(x), dtype=dtype, device=device, requires_grad=requires_grad)


def compute_heading_and_up(
    torso_rotation: Tensor, inv_start_rot: Tensor, to_target: Tensor, vec0: Tensor, vec1: Tensor, up_idx: int
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return how upright a torso is, and how well it faces a target.

    Returns:
        Rotation of the torso from its start orientation, quaternion (n, 4); component `up_idx` of the up vector (n,);
        cosine between heading and target (n,); heading vector (n, 3); up vector (n, 3).
    """
    rotation = quat_mul(torso_rotation, inv_start_rot)
    up, heading = quat_apply(rotation, vec1), quat_apply(rotation, vec0)
    target = to_target / to_target.norm(p=2, dim=-1, keepdim=True).clamp(min=1e-9)
    return rotation, up[:, up_idx], (heading * target).sum(dim=-1), heading, up


def compute_rot(
    torso_quat: Tensor,
    velocity: Tensor,
    ang_velocity: Tensor,
    targets: Tensor,
    torso_positions: Tensor,
    extrinsic: bool = True,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return a torso's velocities and angles, and the angle to a target.

    Returns:
        Linear and angular velocity in the torso's frame (n, 3) each; roll, pitch and yaw in [0, 2 pi) [rad] (n,) each;
        the direction to the target minus the yaw [rad] (n,). As in Isaac Sim, this direction is computed from the x and
        z coordinates.
    """
    roll, pitch, yaw = get_euler_xyz(torso_quat)
    walk = torch.atan2(targets[:, 2] - torso_positions[:, 2], targets[:, 0] - torso_positions[:, 0])
    return rotate_inverse(torso_quat, velocity), rotate_inverse(torso_quat, ang_velocity), roll, pitch, yaw, walk - yaw


maths = rotations = transformations = sys.modules[__name__]

"""Poses as 4 x 4 matrices, Euler angles and interpolation of rotations.

A task of Isaac Lab that imports a name from `isaaclab.utils.math` gets the object of this name from here.
"""

from __future__ import annotations

import inspect

import torch
from torch import Tensor

from rlcli.sim.rotations import cross, rotate_inverse


def matrix_from_euler(euler_angles: Tensor, convention: str) -> Tensor:
    """Return the rotation matrices of intrinsic Euler angles. (..., 3) [rad] -> (..., 3, 3)

    `convention` has the three axes in order, such as "XYZ".
    """
    if len(convention) != 3 or set(convention) - set("XYZ") or convention[1] in (convention[0], convention[2]):
        raise ValueError(f"unknown convention '{convention}'; use three of X, Y and Z, such as XYZ or ZXZ")
    matrices = [_turn(axis, angle) for axis, angle in zip(convention, euler_angles.unbind(-1), strict=True)]
    return matrices[0] @ matrices[1] @ matrices[2]


def _turn(axis: str, angle: Tensor) -> Tensor:
    """Return the matrices of rotations by `angle` [rad] about the axis "X", "Y" or "Z". (...) -> (..., 3, 3)"""
    first, second = {"X": (1, 2), "Y": (2, 0), "Z": (0, 1)}[axis]
    matrix = torch.eye(3, dtype=angle.dtype, device=angle.device).repeat(*angle.shape, 1, 1)
    matrix[..., first, first] = matrix[..., second, second] = angle.cos()
    matrix[..., second, first], matrix[..., first, second] = angle.sin(), -angle.sin()
    return matrix


def make_pose(pos: Tensor, rot: Tensor) -> Tensor:
    """Return pose matrices from positions and rotation matrices. (..., 3), (..., 3, 3) -> (..., 4, 4)"""
    pose = torch.zeros(*pos.shape[:-1], 4, 4, dtype=pos.dtype, device=pos.device)
    pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = rot, pos, 1.0
    return pose


def unmake_pose(pose: Tensor) -> tuple[Tensor, Tensor]:
    """Return positions and rotation matrices of pose matrices. (..., 4, 4) -> (..., 3), (..., 3, 3)"""
    return pose[..., :3, 3], pose[..., :3, :3]


def pose_inv(pose: Tensor) -> Tensor:
    """Return the inverse of pose matrices. (..., 4, 4)"""
    position, rotation = unmake_pose(pose)
    back = rotation.mT
    return make_pose(-(back @ position[..., None])[..., 0], back)


def pose_in_A_to_pose_in_B(pose_in_A: Tensor, pose_A_in_B: Tensor) -> Tensor:  # noqa: N802, N803
    """Return poses relative to the frame B, from poses relative to the frame A. (..., 4, 4) matrices each"""
    return pose_A_in_B @ pose_in_A


def is_identity_pose(pos: Tensor, rot: Tensor) -> bool:
    """Return whether all positions (..., 3) are 0 and all quaternions (w, x, y, z) (..., 4) are the identity."""
    one = torch.zeros_like(rot)
    one[..., 0] = 1.0
    return torch.allclose(pos, torch.zeros_like(pos)) and torch.allclose(rot, one)


def quat_slerp(q1: Tensor, q2: Tensor, tau: float) -> Tensor:
    """Return the rotation at the fraction `tau` (0 to 1) of the shortest way from q1 to q2. (4,) each"""
    if tau in (0.0, 1.0):
        return q2 if tau else q1
    cosine = torch.dot(q1, q2)
    target = torch.where(cosine < 0, -q2, q2)
    angle = cosine.abs().clamp(max=1.0).acos()
    if float(angle) < 1e-6:
        return q1
    return (torch.sin((1.0 - tau) * angle) * q1 + torch.sin(tau * angle) * target) / angle.sin()


def rigid_body_twist_transform(v0: Tensor, w0: Tensor, t01: Tensor, q01: Tensor) -> tuple[Tensor, Tensor]:
    """Return the linear and angular velocity (n, 3) of a body in a frame 1 from those in a frame 0 (v0, w0).

    The pose of frame 1 in frame 0 is the position t01 (n, 3) and the quaternion q01 (n, 4).
    """
    return rotate_inverse(q01, v0 + cross(w0, t01)), rotate_inverse(q01, w0)


__all__ = [name for name, value in dict(globals()).items() if inspect.isfunction(value) and not name.startswith("_")]

"""Success conditions: true of the states that an episode should end in. (num_envs,) bool each."""

from __future__ import annotations

from typing import TYPE_CHECKING

from torch import Tensor

from rlcli.sim.rotations import wrap_to_pi
from rlcli.task import Entity, Joints

if TYPE_CHECKING:
    from rlcli.envs.vec_env import VecEnv


def joints_near(
    env: VecEnv, *, entity: Entity = "robot", joints: Joints = ".*", target: float = 0.0, tolerance: float
) -> Tensor:
    """Every joint is within `tolerance` of `target` [m or rad], the difference wrapped to [-pi, pi]. (num_envs,)"""
    position = entity.data.joint_pos[:, joints]
    return (wrap_to_pi(position - target if target else position).abs_() < tolerance).all(dim=1)


def root_moves(
    env: VecEnv, *, entity: Entity = "robot", direction: tuple[float, float, float] = (1.0, 0.0, 0.0), speed: float
) -> Tensor:
    """The root's velocity, projected on `direction` (world frame, of length 1), is above `speed` [m/s]. (num_envs,)"""
    x, y, z = entity.data.root_lin_vel_w.unbind(dim=1)
    return direction[0] * x + direction[1] * y + direction[2] * z > speed

"""Terms that the example task adds to those of rlcli: the tip's height, and whether the tip is below a height."""

from __future__ import annotations

import torch
from torch import Tensor

from rlcli.task import Entity, Joints


def tip_height(
    env, *, entity: Entity = "robot", joints: Joints = ("shoulder", "elbow"), lengths: tuple[float, float]
) -> Tensor:
    """Return the height of the tip above the shoulder, over the arm's length: -1 hanging, 1 upright. (num_envs,)"""
    shoulder, elbow = entity.data.joint_pos[:, joints].unbind(dim=1)
    upper, lower = lengths
    return (upper * torch.cos(shoulder) + lower * torch.cos(shoulder + elbow)) / (upper + lower)


def tip_below(
    env,
    *,
    entity: Entity = "robot",
    joints: Joints = ("shoulder", "elbow"),
    lengths: tuple[float, float],
    height: float,
) -> Tensor:
    """Return whether the tip is lower than `height`, a fraction of the arm's length. (num_envs,) bool"""
    return tip_height(env, entity=entity, joints=joints, lengths=lengths) < height

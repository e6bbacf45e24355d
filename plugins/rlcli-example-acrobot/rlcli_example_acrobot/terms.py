"""Terms that the example task defines itself: the height of the arm's tip, and whether the tip is below a height."""

from __future__ import annotations

import torch
from torch import Tensor

from rlcli.task import Entity, Joints


def tip_height(
    env, *, entity: Entity = "robot", joints: Joints = ("shoulder", "elbow"), lengths: tuple[float, float]
) -> Tensor:
    """Return the height of the arm's tip above the shoulder, divided by the arm's length. (num_envs,)

    It is -1 if the arm hangs down and 1 if it is upright. `lengths` are those of the upper and the lower link [m].
    """
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
    """Return whether the arm's tip is lower than `height`, in the unit of `tip_height`. (num_envs,) bool"""
    return tip_height(env, entity=entity, joints=joints, lengths=lengths) < height

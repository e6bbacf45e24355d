"""The geometric Jacobian of a body of an entity, from the joints' axes and anchors in the world."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import torch
from torch import Tensor

from rlcli.scene.entity import Entity
from rlcli.sim.rotations import cross


class Jacobian:
    """How a point of a body moves with some hinge and slide joints of its entity.

    A hinge with axis a and anchor p moves a point x by a x (x - p) and turns it by a; a slide moves it by a; a joint
    that does not carry the body does neither.

    Args:
        entity: the robot.
        columns: joint columns.
        body: body column.
    """

    def __init__(self, entity: Entity, columns: Sequence[int], body: int) -> None:
        model, device = entity.engine.model, entity.engine.device
        carrying = set()
        link = int(entity.body_ids[body])
        while link:
            carrying.add(link)
            link = int(model.body_parentid[link])
        joints = [int(entity.joint_ids[c]) for c in columns]
        hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
        carries = [float(int(model.jnt_bodyid[j]) in carrying) for j in joints]
        turns = [float(model.jnt_type[j] == hinge) for j in joints]
        self._carries = torch.tensor(carries, device=device)[:, None]
        self._turns = torch.tensor(turns, device=device)[:, None]
        self._joints = torch.tensor(joints, device=device)
        self._sim = entity.sim

    def __call__(self, point: Tensor) -> Tensor:
        """Rows: linear, then angular velocity of the point, world frame. (num_envs, 3) -> (num_envs, 6, k)"""
        axis = self._sim.derived_field("xaxis")[:, self._joints] * self._carries
        arm = point[:, None] - self._sim.derived_field("xanchor")[:, self._joints]
        linear = torch.where(self._turns > 0.0, cross(axis, arm), axis)
        return torch.cat([linear, axis * self._turns], dim=2).mT

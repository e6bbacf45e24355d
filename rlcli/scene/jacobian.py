"""Geometric Jacobian of a body of an entity, from the joints' axes and anchors in the world."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import torch
from torch import Tensor

from rlcli.scene.entity import Entity
from rlcli.sim.rotations import cross


class Jacobian:
    """Jacobian of a point of a body with respect to hinge and slide joints of its entity.

    The column of a hinge with axis a and anchor p is (cross(a, r - p), a) for a point r. That of a slide with axis a is
    (a, 0). The column of a joint that is not between the body and the world is 0.

    Args:
        entity: the robot.
        columns: indices of the joints in the entity.
        body: index of the body in the entity.
    """

    def __init__(self, entity: Entity, columns: Sequence[int], body: int) -> None:
        model, device = entity.engine.model, entity.engine.device
        ancestors = set()
        link = int(entity.body_ids[body])
        while link:
            ancestors.add(link)
            link = int(model.body_parentid[link])
        joints = [int(entity.joint_ids[c]) for c in columns]
        hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
        moves_body = [float(int(model.jnt_bodyid[j]) in ancestors) for j in joints]
        is_hinge = [float(model.jnt_type[j] == hinge) for j in joints]
        self._moves_body = torch.tensor(moves_body, device=device)[:, None]
        self._is_hinge = torch.tensor(is_hinge, device=device)[:, None]
        self._joints = torch.tensor(joints, device=device)
        self._sim = entity.sim

    def __call__(self, point: Tensor) -> Tensor:
        """Return the Jacobian of a point, linear velocity before angular, world frame. (n, 3) -> (n, 6, k)"""
        axis = self._sim.derived_field("xaxis")[:, self._joints] * self._moves_body
        arm = point[:, None] - self._sim.derived_field("xanchor")[:, self._joints]
        linear = torch.where(self._is_hinge > 0.0, cross(axis, arm), axis)
        return torch.cat([linear, axis * self._is_hinge], dim=2).mT

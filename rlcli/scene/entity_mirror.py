"""Mirror image of an entity about the x-z plane of its root, derived from the geometry of the compiled model.

PPO uses it for agents with `symmetry`. With S = diag(1, -1, 1), the mirror image of a position or another vector v is
S v, that of an angular velocity or another pseudovector w is -S w, and that of the quaternion (w, x, y, z) is
(w, -x, y, -z).
"""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli.errors import TaskError
from rlcli.scene.entity import Entity

Points = NDArray[np.float64]
VECTOR, PSEUDOVECTOR, QUATERNION = (1, -1, 1), (-1, 1, -1), (1, -1, 1, -1)
"""Signs by which the components of a quantity are multiplied to reflect the quantity about the x-z plane."""
_TOLERANCE = 1e-3
"""Largest distance between an element and the mirror image of its partner [m].

The components of unit vectors along joint axes may differ by the same number.
"""


class EntityMirror:
    """Mirror image of an entity, which assigns a partner to each joint. A joint on the mirror plane is its own partner.

    Raises:
        TaskError: if a body has no mirror image, or a joint differs from the mirror image of its partner.
    """

    def __init__(self, entity: Entity) -> None:
        self._root, self._model = entity.root_body, entity.engine.model
        self._data = mujoco.MjData(self._model)
        mujoco.mj_kinematics(self._model, self._data)
        self._axes = self._data.xmat[self._root].reshape(3, 3)
        self._bodies: dict[int, int] = {}
        self.joints: dict[int, tuple[int, int]] = {}
        """Id of a joint -> (id of its partner, sign that converts the joint's coordinate to the partner's)."""
        for body in range(self._root, self._model.nbody):  # a parent comes before its children
            if body == self._root or int(self._model.body_parentid[body]) in self._bodies:
                self._pair(body)

    def reflect(self, qpos: Tensor, qvel: Tensor, to_qpos: Tensor, to_qvel: Tensor) -> None:
        """Write the mirror image of this entity's columns of `qpos` and `qvel` to `to_qpos` and `to_qvel`.

        The tensors are (n, nq) and (n, nv), one state of the whole model in each row.
        """
        model = self._model
        for joint, (partner, sign) in self.joints.items():
            q, v, to_q, to_v = (
                int(start[each]) for each in (joint, partner) for start in (model.jnt_qposadr, model.jnt_dofadr)
            )
            if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
                to_qpos[:, to_q : to_q + 7] = qpos[:, q : q + 7] * torch.tensor((*VECTOR, *QUATERNION))
                to_qvel[:, to_v : to_v + 6] = qvel[:, v : v + 6] * torch.tensor((*VECTOR, *PSEUDOVECTOR))
            else:  # relative to qpos0, the reference pose of the joint
                to_qpos[:, to_q] = sign * (qpos[:, q] - model.qpos0[q]) + model.qpos0[to_q]
                to_qvel[:, to_v] = sign * qvel[:, v]

    def _pair(self, body: int) -> None:
        """Find the body that is the mirror image of `body`, and pair the joints of both.

        The mirror image is searched among the children of the mirror image of the body's parent.
        """
        model, data = self._model, self._data
        partner = body
        if body != self._root:
            parent = self._bodies[int(model.body_parentid[body])]
            fits = (model.body_parentid == parent) & (model.body_jntnum == model.body_jntnum[body])
            fits &= self._distance(data.xpos, data.xpos[body]) < _TOLERANCE
            found = [int(other) for other in np.flatnonzero(fits) if other not in self._bodies.values()]
            if not found:
                raise self._error(body, "has no mirror image")
            away = self._distance(data.xipos, data.xipos[body])
            partner = min(found, key=lambda other: float(away[other]))
        self._bodies[body] = partner
        for number in range(int(model.body_jntnum[body])):
            joint, other = int(model.body_jntadr[body]) + number, int(model.body_jntadr[partner]) + number
            self.joints[joint] = other, self._sign(body, joint, other)

    def _sign(self, body: int, joint: int, other: int) -> int:
        """Return the sign by which the coordinate of `joint` is multiplied to get that of its partner `other`.

        The sign of the root's free joint is +1.
        """
        model, data, kind = self._model, self._data, self._model.jnt_type[joint]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            return 1
        turns = kind == mujoco.mjtJoint.mjJNT_HINGE  # the axis of a hinge is a pseudovector
        image = data.xaxis[joint] @ self._axes * (PSEUDOVECTOR if turns else VECTOR)
        axis = data.xaxis[other] @ self._axes
        sign = 1 if axis @ image > 0 else -1
        same = kind == model.jnt_type[other] and kind != mujoco.mjtJoint.mjJNT_BALL
        if not same or np.abs(sign * axis - image).max() > _TOLERANCE:
            raise self._error(body, f"has another type or axis than the mirror image of '{model.joint(other).name}'")
        if turns and self._distance(data.xanchor[other], data.xanchor[joint]) > _TOLERANCE:
            raise self._error(body, f"is not at the position of the mirror image of '{model.joint(other).name}'")
        return sign

    def _error(self, body: int, reason: str) -> TaskError:
        model, first = self._model, int(self._model.body_jntadr[body])
        name = f"joint '{model.joint(first).name}'" if first >= 0 else f"body '{model.body(body).name}'"
        plane = f"the x-z plane of the root '{model.body(self._root).name}'"
        return TaskError(f"{name} {reason}: the model is not symmetric about {plane}")

    def _distance(self, points: Points, point: Points) -> Points:
        """Return the distances of `points` from the mirror image of `point`. (..., 3), (3,) -> (...)"""
        root = self._data.xpos[self._root]
        away: Points = np.linalg.norm((points - root) @ self._axes - (point - root) @ self._axes * VECTOR, axis=-1)
        return away

"""Random poses of a robot, and the positions that one of its bodies reaches in them, by forward kinematics."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

_COUNT = 2048
"""Number of random poses."""
_SHARES = np.linspace(0.125, 1.0, 8)
"""Points of the way to a pose at which contacts are computed, as shares of the way."""


def reachable_positions(
    model: mujoco.MjModel,
    default: NDArray[np.float64],
    joints: Sequence[int],
    body: int,
    offsets: tuple[float, float],
) -> NDArray[np.float64]:
    """Return positions of a body in random poses, world frame. (n, 3) [m]

    The joints can move to each pose on a straight line from the default pose: poses with a contact on the way that the
    default pose does not have, for example between two links or with the ground, are left out. If no other pose is
    left, they count.

    Args:
        model: the compiled scene.
        default: qpos of the default pose. (nq,)
        joints: ids of the hinges and slides to move.
        body: id of the body.
        offsets: smallest and largest offset of a joint from its default position [m or rad], within the joint's limits.
    """
    data = mujoco.MjData(model)
    usual = _contacts(model, data, default)
    poses = random_poses(model, default, joints, offsets, _COUNT)
    free = [
        qpos
        for qpos in poses
        if all(_contacts(model, data, default + share * (qpos - default)) <= usual for share in _SHARES)
    ]
    places = []
    for qpos in free or poses:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        places.append(data.xpos[body].copy())
    return np.array(places)


def random_poses(
    model: mujoco.MjModel,
    default: NDArray[np.float64],
    joints: Sequence[int],
    offsets: tuple[float, float],
    count: int,
) -> NDArray[np.float64]:
    """Return uniformly drawn poses, the same ones in each call, as qpos. (count, nq)

    For the arguments see `reachable_positions`.
    """
    generator, addresses = np.random.default_rng(0), model.jnt_qposadr[list(joints)]
    limited = model.jnt_limited[list(joints)].astype(bool)
    low, high = (
        np.where(
            limited, np.clip(default[addresses] + offset, *model.jnt_range[list(joints)].T), default[addresses] + offset
        )
        for offset in offsets
    )
    poses = np.tile(default, (count, 1))
    poses[:, addresses] = generator.uniform(low, high, (count, len(addresses)))
    follow_coupled_joints(model, poses, joints)
    return poses


def follow_coupled_joints(model: mujoco.MjModel, poses: NDArray[np.float64], joints: Sequence[int]) -> None:
    """Set the joints that equalities couple to one of `joints` in poses. (n, nq)"""
    for follower, leader, coefficients in coupled_joints(model):
        own, other = model.jnt_qposadr[follower], model.jnt_qposadr[leader]
        if leader in joints:
            moved = np.polynomial.Polynomial(coefficients)(poses[:, other] - model.qpos0[other])
            poses[:, own] = model.qpos0[own] + moved


def coupled_joints(model: mujoco.MjModel) -> list[tuple[int, int, NDArray[np.float64]]]:
    """Return follower, leader and polynomial coefficients of each active equality between two joints."""
    between = (model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)) & (model.eq_obj2id >= 0) & (model.eq_active0 != 0)
    return [(int(model.eq_obj1id[e]), int(model.eq_obj2id[e]), model.eq_data[e, :5]) for e in np.flatnonzero(between)]


def _contacts(model: mujoco.MjModel, data: mujoco.MjData, qpos: NDArray[np.float64]) -> set[tuple[int, int]]:
    """Return the pairs of geoms that touch at `qpos`."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    pairs = data.contact.geom[data.contact.dist < 0.0]
    return {(int(first), int(second)) for first, second in pairs}

"""Compute positions that a body of a robot can reach, by forward kinematics of random poses.

Command terms sample reachable goals from these positions.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

_COUNT = 2048
"""Number of random poses that `reachable_positions` samples."""
_SHARES = np.linspace(0.125, 1.0, 8)
"""Points of the straight way from the default pose to a pose at which contacts are computed (0: start, 1: end)."""
_MEMORY = 8
"""Largest number of results that `reachable_positions` keeps: `rlcli check` builds the same environment many times."""
_results: dict[bytes, NDArray[np.float64]] = {}
"""Digest of the arguments of `reachable_positions` -> its result."""


def reachable_positions(
    model: mujoco.MjModel,
    default: NDArray[np.float64],
    joints: Sequence[int],
    body: int,
    offsets: tuple[float, float],
) -> NDArray[np.float64]:
    """Return positions of a body in random poses of its robot, world frame. (n, 3) [m]

    Poses are left out if a contact that the default pose does not have, for example between two links or with the
    ground, occurs when the joints move to the pose on a straight line from the default pose. If that leaves out all
    poses, none is left out.

    Args:
        model: the compiled scene.
        default: qpos of the default pose. (nq,)
        joints: ids of the hinges and slides to move.
        body: id of the body.
        offsets: smallest and largest offset of a joint from its default position [m or rad], within the joint's limits.
    """
    key = _digest(model, np.array([*default, *joints, body, *offsets, len(joints)]))
    if key in _results:
        return _results[key]
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
    if len(_results) >= _MEMORY:
        _results.clear()
    _results[key] = np.array(places)
    _results[key].flags.writeable = False
    return _results[key]


def _digest(model: mujoco.MjModel, numbers: NDArray[np.float64]) -> bytes:
    """Return a digest of a compiled model, including meshes and names, and of an array of numbers."""
    content = np.zeros(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, content)
    return hashlib.blake2b(numbers.tobytes(), key=hashlib.blake2b(content.tobytes()).digest()).digest()


def random_poses(
    model: mujoco.MjModel,
    default: NDArray[np.float64],
    joints: Sequence[int],
    offsets: tuple[float, float],
    count: int,
) -> NDArray[np.float64]:
    """Return uniformly sampled poses, the same ones in each call, as rows of qpos. (count, nq)

    The arguments are those of `reachable_positions`.
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
    """Set the positions of joints that an equality of the MJCF couples to one of `joints`, in `poses` in place.

    `poses` has a pose (qpos) in each row, (n, nq); `joints` are ids of joints whose positions are set.
    """
    for follower, leader, coefficients in coupled_joints(model):
        own, other = model.jnt_qposadr[follower], model.jnt_qposadr[leader]
        if leader in joints:
            moved = np.polynomial.Polynomial(coefficients)(poses[:, other] - model.qpos0[other])
            poses[:, own] = model.qpos0[own] + moved


def coupled_joints(model: mujoco.MjModel) -> list[tuple[int, int, NDArray[np.float64]]]:
    """Return (follower, leader, polynomial coefficients) of each active equality between two joints.

    Follower and leader are ids of joints. The offset of the follower from its position in qpos0 is the polynomial of
    the leader's offset; the constant coefficient is the first.
    """
    between = (model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)) & (model.eq_obj2id >= 0) & (model.eq_active0 != 0)
    return [(int(model.eq_obj1id[e]), int(model.eq_obj2id[e]), model.eq_data[e, :5]) for e in np.flatnonzero(between)]


def _contacts(model: mujoco.MjModel, data: mujoco.MjData, qpos: NDArray[np.float64]) -> set[tuple[int, int]]:
    """Return the pairs of geoms, as ids, that penetrate each other at `qpos`."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    pairs = data.contact.geom[data.contact.dist < 0.0]
    return {(int(first), int(second)) for first, second in pairs}

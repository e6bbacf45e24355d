"""Positions that a body of a robot reaches, by forward kinematics of random joint positions."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

_COUNT = 2048
"""Number of random poses."""


def reachable_positions(
    model: mujoco.MjModel,
    default: NDArray[np.float64],
    joints: Sequence[int],
    body: int,
    offsets: tuple[float, float],
) -> NDArray[np.float64]:
    """Return positions of a body for random joint positions, world frame. (n, 3) [m]

    The random numbers are the same in each call. Poses with a contact that the default pose does not have, for example
    between two links or with the ground, are left out; if no other pose is left, they count.

    Args:
        model: the compiled scene.
        default: qpos of the default pose. (nq,)
        joints: ids of the hinges and slides to move.
        body: id of the body.
        offsets: smallest and largest offset of a joint from its default position [m or rad], within the joint's limits.
    """
    generator, data, addresses = np.random.default_rng(0), mujoco.MjData(model), model.jnt_qposadr[list(joints)]
    limited = model.jnt_limited[list(joints)].astype(bool)
    low, high = (
        np.where(
            limited, np.clip(default[addresses] + offset, *model.jnt_range[list(joints)].T), default[addresses] + offset
        )
        for offset in offsets
    )
    usual = _contacts(model, data, default)
    free: list[NDArray[np.float64]] = []
    touching: list[NDArray[np.float64]] = []
    for sample in generator.uniform(low, high, (_COUNT, len(addresses))):
        qpos = default.copy()
        qpos[addresses] = sample
        collides = not _contacts(model, data, qpos) <= usual
        (touching if collides else free).append(data.xpos[body].copy())
    return np.array(free or touching)


def _contacts(model: mujoco.MjModel, data: mujoco.MjData, qpos: NDArray[np.float64]) -> set[tuple[int, int]]:
    """Return the pairs of geoms that touch at `qpos`; also compute the positions of the bodies in `data`."""
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_collision(model, data)
    pairs = data.contact.geom[data.contact.dist < 0.0]
    return {(int(first), int(second)) for first, second in pairs}

"""Estimate the largest numbers of contacts and constraints in a world, the simulation of one environment.

MuJoCo Warp, on which the GPU engine is built, allocates memory for contacts and constraints in advance.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from rlcli.sim.skippable_work import colliding_pairs

_TRIALS, _STEPS = 16, 100
_MARGIN = 3
"""Safety factor: the capacity is this factor times the largest number found in short random simulations."""
_DEFAULT_CONTACTS = 8
"""Largest number of contacts of a pair of geoms that is not in `_PAIR_CONTACTS`, such as two boxes."""
_HFIELD_CONTACTS = 50
"""Largest number of contacts of a geom with a height field (mjMAXCONPAIR)."""
_G = mujoco.mjtGeom
_PAIR_CONTACTS = {
    (_G.mjGEOM_PLANE, _G.mjGEOM_SPHERE): 1,
    (_G.mjGEOM_PLANE, _G.mjGEOM_ELLIPSOID): 1,
    (_G.mjGEOM_PLANE, _G.mjGEOM_CAPSULE): 2,
    (_G.mjGEOM_PLANE, _G.mjGEOM_CYLINDER): 4,
    (_G.mjGEOM_PLANE, _G.mjGEOM_BOX): 4,
    (_G.mjGEOM_SPHERE, _G.mjGEOM_SPHERE): 1,
    (_G.mjGEOM_SPHERE, _G.mjGEOM_CAPSULE): 1,
    (_G.mjGEOM_SPHERE, _G.mjGEOM_BOX): 1,
    (_G.mjGEOM_CAPSULE, _G.mjGEOM_CAPSULE): 2,
    (_G.mjGEOM_CAPSULE, _G.mjGEOM_BOX): 2,
}
"""Pair of geom types -> its largest number of contacts."""


@dataclass(frozen=True, slots=True)
class Capacity:
    """Largest numbers of contacts, and of rows of the constraint Jacobian, in a world."""

    contacts: int
    constraints: int


def required_capacity(model: mujoco.MjModel, contacts: int | None = None, constraints: int | None = None) -> Capacity:
    """Return the numbers of contacts and constraint rows for which each world of a model needs memory.

    Each number is an upper bound, or three times the maximum in random simulations if that is smaller.

    Args:
        model: the compiled model.
        contacts: number of contacts that replaces the estimate; None: estimate.
        constraints: number of constraint rows that replaces the estimate; None: estimate.
    """
    bound_contacts, bound_rows = _upper_bound(model)
    sampled_contacts, sampled_rows = _sampled_maximum(model)
    found_contacts = min(bound_contacts, max(32, _MARGIN * sampled_contacts))
    found_rows = min(bound_rows, max(64, _MARGIN * sampled_rows))
    return Capacity(contacts or max(1, found_contacts), constraints or max(1, found_rows))


def _upper_bound(model: mujoco.MjModel) -> tuple[int, int]:
    """Return upper bounds of the numbers of (contacts, constraint rows) in a world."""
    contacts = rows = 0
    for a, b in colliding_pairs(model):
        kinds = tuple(sorted((_G(model.geom_type[a]), _G(model.geom_type[b])), key=int))
        points = _HFIELD_CONTACTS if _G.mjGEOM_HFIELD in kinds else _PAIR_CONTACTS.get(kinds, _DEFAULT_CONTACTS)
        condim = int(max(model.geom_condim[a], model.geom_condim[b]))
        contacts += points
        rows += points * _contact_rows(model, condim)
    for pair in range(model.npair):
        contacts += _DEFAULT_CONTACTS
        rows += _DEFAULT_CONTACTS * _contact_rows(model, int(model.pair_dim[pair]))
    limits = int(model.jnt_limited.sum() + model.tendon_limited.sum()) * 2
    friction = int((model.dof_frictionloss > 0).sum() + (model.tendon_frictionloss > 0).sum())
    return contacts, rows + limits + friction + 6 * model.neq


def _contact_rows(model: mujoco.MjModel, condim: int) -> int:
    """Return the number of constraint rows of a contact with the dimension `condim` and the model's friction cone."""
    pyramidal = model.opt.cone == int(mujoco.mjtCone.mjCONE_PYRAMIDAL)
    return 1 if condim == 1 else 2 * (condim - 1) if pyramidal else condim


def _sampled_maximum(model: mujoco.MjModel) -> tuple[int, int]:
    """Return the largest numbers of (contacts, constraint rows) in short simulations with random motion and controls.

    Half of the simulations begin with random joint positions, half of them at a random point of a height field.
    """
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    contacts = rows = 0
    for trial in range(_TRIALS):
        mujoco.mj_resetData(model, data)
        data.qvel[:] = rng.normal(0.0, 1.0, model.nv)
        if trial % 2:
            _move_on_height_field(model, data, rng)
        if trial % 4 > 1:
            _move_joints(model, data, rng)
        for _ in range(_STEPS):
            data.ctrl[:] = rng.uniform(-1.0, 1.0, model.nu)
            mujoco.mj_step(model, data)
            contacts, rows = max(contacts, data.ncon), max(rows, data.nefc)
    return contacts, rows


def _move_joints(model: mujoco.MjModel, data: mujoco.MjData, rng: np.random.Generator) -> None:
    """Move hinges and slides to random positions within their limits, or within 1 rad or 1 m of 0."""
    scalar = model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)
    limits = np.where(model.jnt_limited[:, None], model.jnt_range, [-1.0, 1.0])[scalar]
    data.qpos[model.jnt_qposadr[scalar]] = rng.uniform(limits[:, 0], limits[:, 1])


def _move_on_height_field(model: mujoco.MjModel, data: mujoco.MjData, rng: np.random.Generator) -> None:
    """Move all bodies with a free joint to a random point of the first height field; without one do nothing."""
    fields = np.flatnonzero(model.geom_type == int(_G.mjGEOM_HFIELD))
    if not len(fields):
        return
    geom = int(fields[0])
    field = int(model.geom_dataid[geom])
    rows, columns, start = (int(a[field]) for a in (model.hfield_nrow, model.hfield_ncol, model.hfield_adr))
    row, column = int(rng.integers(rows)), int(rng.integers(columns))
    half_x, half_y, top, _ = model.hfield_size[field]
    shift = model.geom_pos[geom] + [
        half_x * (2.0 * column / (columns - 1) - 1.0),
        half_y * (2.0 * row / (rows - 1) - 1.0),
        top * model.hfield_data[start + row * columns + column],
    ]
    for joint in np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
        address = int(model.jnt_qposadr[joint])
        data.qpos[address : address + 3] += shift

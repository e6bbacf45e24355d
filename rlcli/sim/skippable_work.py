"""Find the computations that MuJoCo can skip in a step of a model without changing a bit of the simulation.

MuJoCo prepares collision detection even if no two geoms may touch, it prepares constraints even if the model can have
none, and it searches constraint islands even in a model of one kinematic tree, which is one island. (The profiler of
MuJoCo's Python bindings, which takes a third of the time of a small model, is turned off by
`rlcli.sim.mujoco_private.without_profiler`.)
"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

_D = mujoco.mjtDisableBit
FIELDS_OF_SKIPPED_WORK = frozenset(
    ["nisland", "nidof", "solver_niter", "solver_nnz", "solver_fwdinv", "bvh_active", "bvh_aabb_dyn"]
)
"""Fields of MjData that only the skipped computations write; if a task reads one of them, nothing is skipped."""
FIELDS_OF_FRICTION = frozenset(["dof_frictionloss", "tendon_frictionloss"])
"""Fields of MjModel with real numbers that decide whether a model can have constraints."""


def skippable_flags(model: mujoco.MjModel) -> int:
    """Return the disable flags (mjtDisableBit) that can be set without changing a bit of the simulation.

    The flags hold as long as no integer field of the model changes, because these fields decide which geoms may touch.
    The flag that disables constraints holds only as long as no field in `FIELDS_OF_FRICTION` changes either.
    """
    flags = 0
    sleeps = model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    if not model.npair and not model.nflex and next(colliding_pairs(model), None) is None:
        flags |= int(_D.mjDSBL_CONTACT)
        limited = model.jnt_limited.any() or model.tendon_limited.any()
        friction = model.dof_frictionloss.any() or model.tendon_frictionloss.any()
        if not (model.neq or limited or friction or sleeps):
            flags |= int(_D.mjDSBL_CONSTRAINT)
    newton = model.opt.solver == int(mujoco.mjtSolver.mjSOL_NEWTON) and not model.opt.noslip_iterations
    if model.ntree == 1 and newton and not sleeps and not model.nflex:
        flags |= int(_D.mjDSBL_ISLAND)
    return flags


def colliding_pairs(model: mujoco.MjModel) -> Iterator[tuple[int, int]]:
    """Yield the pairs of geoms that may touch according to MuJoCo's filters.

    In such a pair the contype and conaffinity match, and the bodies are neither welded together nor parent and child.
    Explicit pairs of the MJCF, to which no filter applies, are not included.
    """
    weld = model.body_weldid
    parent = weld[model.body_parentid[weld]]
    filters_parents = not model.opt.disableflags & int(_D.mjDSBL_FILTERPARENT)
    excluded = model.exclude_signature
    kind, affinity = model.geom_contype, model.geom_conaffinity
    solid = np.flatnonzero(kind | affinity)
    moves = model.body_treeid[model.geom_bodyid] >= 0
    for a in solid:
        # two static or mocap geoms never touch; leave them out early, because a terrain may have thousands
        others = solid[(solid > a) & (moves[a] | moves[solid])]
        others = others[((kind[a] & affinity[others]) | (kind[others] & affinity[a])) != 0]
        one, many = model.geom_bodyid[a], model.geom_bodyid[others]
        welded = weld[many] == weld[one]
        related = (weld[one] > 0) & (weld[many] > 0) & ((weld[one] == parent[many]) | (weld[many] == parent[one]))
        signature = (np.minimum(one, many) << 16) + np.maximum(one, many)
        for b in others[~(welded | (filters_parents & related) | np.isin(signature, excluded))]:
            yield int(a), int(b)

"""Work that MuJoCo may skip in a step without changing a bit of the result.

MuJoCo prepares collision detection even for geoms of which no two may touch, and gathers the constraints of a single
tree into islands, of which there is one. Its Python bindings also keep the engine's profiler on, some thirty reads of
the clock a step, a third of the time of a small model: see `rlcli.sim.mujoco_private.without_profiler`.
"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

_D = mujoco.mjtDisableBit
FIELDS_OF_SKIPPED_WORK = frozenset(
    ["nisland", "nidof", "solver_niter", "solver_nnz", "solver_fwdinv", "bvh_active", "bvh_aabb_dyn"]
)
"""Fields of MjData that the skipped work writes."""


def skippable_flags(model: mujoco.MjModel) -> int:
    """Return the disable flags (mjtDisableBit) that change no bit of MuJoCo's states.

    Valid as long as no integer of the model changes: integers decide which geoms may touch.
    """
    flags = 0
    if not model.npair and not model.nflex and next(colliding_pairs(model), None) is None:
        flags |= int(_D.mjDSBL_CONTACT)
    sleeps = model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    newton = model.opt.solver == int(mujoco.mjtSolver.mjSOL_NEWTON) and not model.opt.noslip_iterations
    if model.ntree == 1 and newton and not sleeps and not model.nflex:
        flags |= int(_D.mjDSBL_ISLAND)
    return flags


def colliding_pairs(model: mujoco.MjModel) -> Iterator[tuple[int, int]]:
    """Yield the pairs of geoms that MuJoCo's filters let touch.

    Their bits match, and their bodies are neither welded nor parent and child. Explicit pairs, which skip the filters,
    are not among them.
    """
    weld = model.body_weldid
    above = weld[model.body_parentid[weld]]
    families = not model.opt.disableflags & int(_D.mjDSBL_FILTERPARENT)
    excluded = model.exclude_signature
    kind, affinity = model.geom_contype, model.geom_conaffinity
    solid = np.flatnonzero(kind | affinity)
    moves = weld[model.geom_bodyid] > 0
    for a in solid:
        # of two that stand still none touches the other, and a terrain may have thousands
        others = solid[(solid > a) & (moves[a] | moves[solid])]
        others = others[((kind[a] & affinity[others]) | (kind[others] & affinity[a])) != 0]
        one, many = model.geom_bodyid[a], model.geom_bodyid[others]
        welded = weld[many] == weld[one]
        related = (weld[one] > 0) & (weld[many] > 0) & ((weld[one] == above[many]) | (weld[many] == above[one]))
        signature = (np.minimum(one, many) << 16) + np.maximum(one, many)
        for b in others[~(welded | (families & related) | np.isin(signature, excluded))]:
            yield int(a), int(b)

"""Avoid a bug of MuJoCo 4.0.0, whose sparse Newton solver computes wrong accelerations for some models.

The factorization of a sparse Hessian merges rows that must stay apart. This happens only if a constraint couples
joints of two branches: a contact of two moving bodies, an equality or a tendon. MuJoCo 4.0.1 corrects the bug.
"""

from __future__ import annotations

import logging

import mujoco
import numpy as np

from rlcli.sim.skippable_work import colliding_pairs

_log = logging.getLogger(__name__)

_VERSION = "4.0.0"
_AUTO_SPARSE = 60
"""Number of degrees of freedom from which MuJoCo's `jacobian="auto"` is sparse."""


def avoid_sparse_newton(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Choose MuJoCo's dense solver for a model that the bug can affect; log a warning if its MJCF sets the sparse one.

    Args:
        spec: the specification of the model, whose option is set, too.
        model: the compiled model.
    """
    option = model.opt
    sparse = option.jacobian == mujoco.mjtJacobian.mjJAC_SPARSE
    automatic = option.jacobian == mujoco.mjtJacobian.mjJAC_AUTO and model.nv >= _AUTO_SPARSE
    if (
        mujoco.__version__ != _VERSION
        or option.solver != mujoco.mjtSolver.mjSOL_NEWTON
        or not (sparse or automatic)
        or not couples_branches(model)
    ):
        return
    if automatic:
        spec.option.jacobian = option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        return
    _log.warning(
        'scene: the MJCF sets jacobian="sparse", with which the Newton solver of MuJoCo %s can compute wrong'
        ' accelerations for this model; set jacobian="dense" or solver="CG" until MuJoCo 4.0.1',
        _VERSION,
    )


def couples_branches(model: mujoco.MjModel) -> bool:
    """Return whether a constraint may couple joints of two branches of the kinematic trees."""
    return model.nflex > 0 or _equality_couples(model) or _tendon_couples(model) or _contact_couples(model)


def _equality_couples(model: mujoco.MjModel) -> bool:
    for kind, of_sites, first, second in zip(
        model.eq_type, model.eq_objtype == mujoco.mjtObj.mjOBJ_SITE, model.eq_obj1id, model.eq_obj2id, strict=True
    ):
        if int(kind) in (mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtEq.mjEQ_WELD):
            bodies = model.site_bodyid[[first, second]] if of_sites else np.array([first, second])
            if _moves(model)[bodies].all():
                return True
        elif kind != mujoco.mjtEq.mjEQ_JOINT or second >= 0:
            return True
    return False


def _tendon_couples(model: mujoco.MjModel) -> bool:
    constrained = (model.tendon_limited != 0) | (model.tendon_frictionloss > 0)
    return bool((constrained & (model.ten_J_rownnz > 1)).any())


def _contact_couples(model: mujoco.MjModel) -> bool:
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
        return False
    moves = _moves(model)
    if moves[model.geom_bodyid[model.pair_geom1]].dot(moves[model.geom_bodyid[model.pair_geom2]]):
        return True
    bodies = (model.geom_bodyid[list(pair)] for pair in colliding_pairs(model))
    return any(bool(moves[both].all()) for both in bodies)


def _moves(model: mujoco.MjModel) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return for each body whether physics can move it: the body or a parent has degrees of freedom. (nbody,)"""
    return np.asarray(model.body_treeid >= 0)

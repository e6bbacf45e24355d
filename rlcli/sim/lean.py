"""What MuJoCo may leave out of a step without changing a bit of what comes out.

Its Python bindings keep the engine's profiler on: some thirty looks at the clock a step, a third of the time of a small
model. Collision is prepared for geoms of which no two may touch. The constraints of a single tree are gathered into the
one island that they are.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import threading
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType

import mujoco
import numpy as np

_D = mujoco.mjtDisableBit
SHOWS_IT = frozenset(["nisland", "nidof", "solver_niter", "solver_nnz", "solver_fwdinv", "bvh_active", "bvh_aabb_dyn"])
"""Fields of MjData in which what is left out can be seen."""


def needless(model: mujoco.MjModel) -> int:
    """Disable flags (mjtDisableBit) under which MuJoCo's states are the same to the bit.

    Valid as long as no integer of the model changes: those decide what may touch.
    """
    flags = 0
    if not model.npair and not model.nflex and next(touching(model), None) is None:
        flags |= int(_D.mjDSBL_CONTACT)
    sleeps = model.opt.enableflags & int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    newton = model.opt.solver == int(mujoco.mjtSolver.mjSOL_NEWTON) and not model.opt.noslip_iterations
    if model.ntree == 1 and newton and not sleeps and not model.nflex:
        flags |= int(_D.mjDSBL_ISLAND)
    return flags


def touching(model: mujoco.MjModel) -> Iterator[tuple[int, int]]:
    """Geoms that MuJoCo's filters let touch: bits that match, bodies that are neither welded nor parent and child.

    Explicit pairs, which no filter holds back, are not among them.
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


class _Unprofiled:
    """`with unprofiled:` MuJoCo does not look at the clock. Timers of who steps elsewhere meanwhile are wrong.

    `mjcb_time` is a variable of MuJoCo's C library. Python's `set_mjcb_time(None)` puts the bindings' own clock there.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._clock: int | None = None

    @functools.cached_property
    def _callback(self) -> ctypes.c_void_p:
        for name in ("libmujoco*.so*", "libmujoco*.dylib", "mujoco.dll"):
            for path in Path(mujoco.__file__).parent.glob(name):
                with contextlib.suppress(OSError, ValueError):
                    return ctypes.c_void_p.in_dll(ctypes.CDLL(str(path)), "mjcb_time")
        return ctypes.c_void_p()  # a build of MuJoCo that looks different: timed, as anywhere

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._clock = self._callback.value
                self._callback.value = None
            self._inside += 1

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside and self._callback.value is None:  # nobody else has set one
                self._callback.value = self._clock


unprofiled = _Unprofiled()

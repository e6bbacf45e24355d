"""Functions that use private names of MuJoCo: of `mujoco.batch`, and the clock variable of MuJoCo's C library.

A new version of MuJoCo may rename private names, so no other module uses them.
"""

from __future__ import annotations

import contextlib
import copy
import ctypes
import functools
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import mujoco.batch
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from rlcli.errors import DependencyError, pip_install

_VERSION = "4.0"
"""Version of MuJoCo that has all private names that this module uses."""


def _private(owner: object, name: str) -> Any:
    """Return a private attribute of MuJoCo.

    Raises:
        DependencyError: if the installed version does not have it.
    """
    try:
        return getattr(owner, name)
    except AttributeError:
        raise DependencyError(
            f"MuJoCo {mujoco.__version__} has no '{name}', which rlcli uses; MuJoCo {_VERSION} has it",
            hint=pip_install(f"mujoco=={_VERSION}.*"),
        ) from None


STATE_FIELDS: dict[str, mujoco.mjtState] = _private(mujoco.batch, "_STATE_FIELDS")
"""Field of MjData that is part of the integration state -> MuJoCo's flag (mjtState) for this part."""


def make_batch(
    model: mujoco.MjModel, num_envs: int, threads: int, *, disable_flags: int = 0, persistent: bool = False
) -> Batch:
    """Return a `mujoco.batch.Batch`, which steps many worlds of a model in threads.

    Args:
        model: the compiled model; it is copied, because other threads may step it.
        num_envs: number of worlds.
        threads: number of threads that step the worlds.
        disable_flags: disable flags (mjtDisableBit) to set in addition to those of the model.
        persistent: whether each world has its own MjData.

    Raises:
        DependencyError: if the installed version of MuJoCo does not have a private name that this module uses.
    """
    own = copy.copy(model)
    own.opt.disableflags |= disable_flags
    batch = Batch(own, num_envs, threads, persistent=persistent)
    for name in ("_b", "_check", "_component", "_expanded"):
        _private(batch, name)
    return batch


def state_columns(batch: Batch) -> dict[str, tuple[int, int]]:
    """Return the columns of each field in the integration state, by field: (first column, number of columns)."""
    return {name: batch._component(kind) for name, kind in STATE_FIELDS.items()}


def expanded_fields(batch: Batch) -> dict[str, NDArray[Any]]:
    """Return the batch's own dictionary with the model fields that have a value for each world. (num_envs, ...)"""
    fields: dict[str, NDArray[Any]] = batch._expanded
    return fields


def expand_disable_flags(batch: Batch) -> NDArray[np.int32]:
    """Give each world its own disable flags (mjtDisableBit); return a live view of the flags. (num_envs,)

    The flags have no entry in `expanded_fields`.
    """
    flags: NDArray[np.int32] = batch._b.expand("opt.disableflags").view(np.int32)
    return flags


def forward_of(batch: Batch) -> Callable[[NDArray[np.int64], int], None]:
    """Return the function forward(ids of worlds, stage), which computes derived fields.

    It is `batch.forward` without the checks of ids, which take longer than the computation for few worlds.
    """
    compute, check = batch._b.forward, batch._check

    def forward(ids: NDArray[np.int64], stage: int) -> None:
        worlds = ids.astype(np.int32)
        check(worlds, compute(worlds, stage))

    return forward


class _WithoutProfiler:
    """Context in which MuJoCo's profiler does not read the clock, to save time.

    The context sets `mjcb_time`, a variable of MuJoCo's C library, to NULL. Python's `set_mjcb_time(None)` cannot do
    that, because it sets the clock of the bindings. Timers of other threads that step MuJoCo meanwhile are wrong.
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
        return ctypes.c_void_p()  # this build of MuJoCo has another layout: its profiler stays on

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._clock = self._callback.value
                self._callback.value = None
            self._inside += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._inside -= 1
            # a value other than None means that other code has set a callback
            if not self._inside and self._callback.value is None:
                self._callback.value = self._clock


without_profiler = _WithoutProfiler()

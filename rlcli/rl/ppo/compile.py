"""Faster updates on a GPU: functions fused by torch's compiler, and matrix products in TF32.

Compiled code is stored in the user's cache folder. The compiler is imported only when `compile_update` is called.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import torch

from rlcli.rl.ppo.loss import UpdateFunctions

_FOLDER = "TORCHINDUCTOR_CACHE_DIR"
_log = logging.getLogger(__name__)


def compile_update(
    functions: UpdateFunctions, warm_up: Callable[[UpdateFunctions], None], *, tuned: bool = False
) -> UpdateFunctions:
    """Return the compiled functions; if compiling fails, log a warning and return the functions unchanged.

    Args:
        functions: the functions to compile.
        warm_up: calls each function once with every shape of an update, on tensors that may be overwritten.
        tuned: benchmark kernels for matrix products. This takes half a minute, once per machine.
    """
    _use_user_cache()
    mode = "max-autotune-no-cudagraphs" if tuned else None
    compile_ = functools.partial(torch.compile, fullgraph=True, dynamic=False, mode=mode)
    compiled = UpdateFunctions(*map(compile_, functions))
    try:
        with warnings.catch_warnings(action="ignore"):  # the compiler's warnings are advice for rlcli's authors
            warm_up(compiled)
    except (RuntimeError, ImportError, OSError) as error:
        reason = next(iter(str(error).strip().splitlines()), "")
        _log.warning(
            f"the update cannot be compiled and runs uncompiled ({type(error).__name__}: {reason[:200]});"
            " `agent.compile=false` avoids this warning"
        )
        return functions
    return compiled


@contextlib.contextmanager
def tf32_matmul(allowed: bool) -> Iterator[None]:
    """Allow float32 matrix products in the `with` block to round their factors to TF32 (10 bits of mantissa).

    If `allowed` is false, nothing changes.
    """
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if allowed else before)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def _use_user_cache() -> None:
    """Set the cache folder of the compiler (TORCHINDUCTOR_CACHE_DIR), unless the user has set the variable.

    torch sets the variable to a temporary folder, `torchinductor_USER`, when torch is imported.
    """
    import platformdirs

    folder = os.environ.get(_FOLDER)
    if not folder or Path(folder).name.startswith("torchinductor_"):
        os.environ[_FOLDER] = str(Path(platformdirs.user_cache_dir("rlcli")) / "inductor")

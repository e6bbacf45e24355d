"""What makes an update quick on a GPU: its parts fused by torch's own compiler, and matrices on tensor cores.

What is compiled is kept in the user's cache folder. Nothing of a compiler is imported before `fused` is called.
"""

from __future__ import annotations

import contextlib
import functools
import os
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import torch

from rlcli.rl.ppo_loss import Parts

_FOLDER = "TORCHINDUCTOR_CACHE_DIR"


def fused(
    parts: Parts, rehearse: Callable[[Parts], None], tell: Callable[[str], None], *, tuned: bool = False
) -> Parts:
    """The same functions, compiled; where they cannot be, as they are.

    Args:
        parts: what is to be compiled.
        rehearse: calls each of them once with every shape that will come, on tensors that may be spoilt.
        tell: told in a sentence if there is no compiler, or it fails.
        tuned: try out kernels for the products of matrices, which takes its time, once a machine.
    """
    _keep_in_users_cache()
    mode = "max-autotune-no-cudagraphs" if tuned else None
    compile_ = functools.partial(torch.compile, fullgraph=True, dynamic=False, mode=mode)
    compiled = Parts(compile_(parts.judge), compile_(parts.clip_), compile_(parts.adapt_))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # advice to those who wrote what is compiled
            rehearse(compiled)
    except (RuntimeError, ImportError, OSError) as error:
        said = next(iter(str(error).strip().splitlines()), "")
        tell(f"the update cannot be compiled and runs as it is: {type(error).__name__}: {said[:200]}")
        return parts
    return compiled


@contextlib.contextmanager
def tensor_cores(allowed: bool) -> Iterator[None]:
    """Where it is allowed, products of float32 matrices may round what they multiply to TF32, 10 bits of mantissa."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("high" if allowed else before)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def _keep_in_users_cache() -> None:
    """Let compiled code outlive the machine's temporary folder, where torch names a place as soon as it is imported."""
    import platformdirs

    asked = os.environ.get(_FOLDER)
    if not asked or Path(asked).name.startswith("torchinductor_"):
        os.environ[_FOLDER] = str(Path(platformdirs.user_cache_dir("rlcli")) / "inductor")

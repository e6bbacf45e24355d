"""The parts of an update, fused by torch's own compiler, so that a GPU launches few kernels instead of many.

What is compiled is kept in the user's cache folder. Nothing of a compiler is imported before `fused` is called.
"""

from __future__ import annotations

import functools
import os
import warnings
from collections.abc import Callable
from pathlib import Path

import torch

from rlcli.rl.ppo_loss import Parts


def fused(parts: Parts, rehearse: Callable[[Parts], None], tell: Callable[[str], None]) -> Parts:
    """The same functions, compiled; where they cannot be, as they are.

    Args:
        parts: what is to be compiled.
        rehearse: calls each of them once with every shape that will come, on tensors that may be spoilt.
        tell: told in a sentence if there is no compiler, or it fails.
    """
    import platformdirs

    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(Path(platformdirs.user_cache_dir("rlcli")) / "inductor"))
    compile_ = functools.partial(torch.compile, fullgraph=True, dynamic=False)
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

"""Seed, save and restore the global random generators of torch, numpy and Python.

Trainers save the states of the generators in checkpoints. Evaluations during a training restore the states, so that
they do not change the training.
"""

from __future__ import annotations

import contextlib
import math
import random
from collections.abc import Iterator, Mapping

import numpy as np
import torch
from torch import Tensor

from rlcli.sim.saved_tensors import require_in_range, require_matching_tensors


def seed_generators(seed: int) -> None:
    """Seed the global generators of torch, numpy and Python."""
    torch.manual_seed(seed)
    np.random.seed(seed % 2**32)
    random.seed(seed)


def rng_state() -> dict[str, Tensor]:
    """Return copies of the states of the global generators of torch (CPU), numpy and Python, as tensors by name."""
    kind, keys, position, has_gauss, gauss = np.random.get_state()
    assert kind == "MT19937"
    version, words, next_gauss = random.getstate()
    return {
        "torch": torch.get_rng_state(),
        "numpy.keys": torch.from_numpy(np.asarray(keys).astype(np.int64)),
        "numpy.position": torch.tensor([int(position), int(has_gauss)]),
        "numpy.gauss": torch.tensor([float(gauss)], dtype=torch.float64),
        "python.words": torch.tensor([version, *words], dtype=torch.int64),
        "python.gauss": torch.tensor([math.nan if next_gauss is None else next_gauss], dtype=torch.float64),
    }


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """Run a `with` block that must not change the random numbers after it.

    The block runs with one torch thread; afterwards the global generators and the number of threads are restored.
    """
    rng, threads = rng_state(), torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        load_rng_state(rng)
        torch.set_num_threads(threads)


def load_rng_state(state: Mapping[str, Tensor]) -> None:
    """Restore the states returned by `rng_state()`.

    Raises:
        KeyError: if a tensor is missing.
        ValueError: if a tensor is not the state of a generator.
    """
    require_matching_tensors(state, rng_state(), "rng")
    position, has_gauss = state["numpy.position"]
    require_in_range(position, 0, len(state["numpy.keys"]), "numpy.position")  # numpy does not check the position
    require_in_range(has_gauss, 0, 1, "numpy.position")
    for name in ("numpy.keys", "python.words"):
        require_in_range(state[name], 0, 2**32 - 1, name)
    torch.set_rng_state(state["torch"])
    keys = state["numpy.keys"].numpy().astype(np.uint32)
    np.random.set_state(("MT19937", keys, int(position), int(has_gauss), float(state["numpy.gauss"])))
    version, *words = state["python.words"].tolist()
    gauss = float(state["python.gauss"])
    random.setstate((version, tuple(words), None if math.isnan(gauss) else gauss))

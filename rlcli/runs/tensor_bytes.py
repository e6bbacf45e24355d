"""Convert tensors to the bytes of a safetensors file, after a check that there is enough memory."""

from collections.abc import Mapping

import numpy as np
import safetensors.torch
from torch import Tensor

_COPIES = 3
"""Number of copies of all tensors that the library safetensors has in memory at a time while it writes bytes."""


def tensor_bytes(tensors: Mapping[str, Tensor], metadata: dict[str, str] | None = None) -> bytes:
    """Return the bytes of a safetensors file with contiguous tensors, by name, and texts (`metadata`) in its header.

    Raises:
        MemoryError: if memory is too small. safetensors itself would abort the process.
    """
    np.empty(_COPIES * sum(tensor.nbytes for tensor in tensors.values()), np.uint8)  # reserved and freed at once
    return safetensors.torch.save(dict(tensors), metadata)

"""Detect host syncs: operations of torch for which the CPU (host) must wait until a GPU has computed a value.

The check `captured` of `rlcli check` uses the detection, which works without a GPU.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

SYNC_OPS = {"_local_scalar_dense", "nonzero", "is_nonzero", "equal", "masked_select", "item", "unique", "_unique2"}
"""Names of torch operations that return a value to the CPU, so that the CPU has to wait for a GPU."""
COPY_OPS = {"lift_fresh", "lift", "from_file"}
"""Names of torch operations that make a tensor from data of the CPU; a CUDA graph cannot record them."""
_MASKED = ("index", "index_put", "index_put_")


class HostSyncError(AssertionError):
    """Error for an operation that forces a host sync, or copies numbers from the host."""


class HostSyncGuard(TorchDispatchMode):  # type: ignore[no-untyped-call]  # torch has no type here
    """Context in which torch operations that would force a host sync on a GPU raise `HostSyncError`, on any device."""

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        """Execute a torch operation; raise `HostSyncError` if it would force a host sync. torch calls this method."""
        name = func.overloadpacket.__name__
        if name in SYNC_OPS:
            raise HostSyncError(f"'{name}' forces a host sync (the CPU waits for the GPU); compute with tensors only")
        if name in COPY_OPS:
            raise HostSyncError(f"'{name}' copies numbers from the host; create the tensor in __init__")
        if name in _MASKED and any(isinstance(i, Tensor) and i.dtype in (torch.bool, torch.uint8) for i in args[1]):
            raise HostSyncError(f"'{name}' with a mask forces a host sync (the CPU waits for the GPU); use torch.where")
        return func(*args, **(kwargs or {}))

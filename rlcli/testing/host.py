"""What makes a step wait for the device: a value that is read back, a size that depends on one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

WAITS = {"_local_scalar_dense", "nonzero", "is_nonzero", "equal", "masked_select", "item", "unique", "_unique2"}
"""Operations whose result the host must have before it goes on."""
COPIES = {"lift_fresh", "lift", "from_file"}
"""Operations that make a tensor of what the host has; none of them can be recorded."""
_MASKED = ("index", "index_put", "index_put_")


class HostReadError(AssertionError):
    """A step asked for a value."""


class NoHost(TorchDispatchMode):
    """Raises `HostReadError` at what would wait for a device, on whatever device it happens."""

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        """Let everything else through."""
        name = func.overloadpacket.__name__
        if name in WAITS:
            raise HostReadError(f"'{name}' waits for the device")
        if name in COPIES:
            raise HostReadError(f"'{name}' makes a tensor of numbers of the host, which waits for the device")
        if name in _MASKED and any(isinstance(i, Tensor) and i.dtype in (torch.bool, torch.uint8) for i in args[1]):
            raise HostReadError(f"'{name}' with a mask is a search, which waits for the device")
        return func(*args, **(kwargs or {}))

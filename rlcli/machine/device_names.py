"""Context for code that names the device `cuda` on a machine without a GPU: the CPU takes the place of `cuda`."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import torch
from torch.overrides import TorchFunctionMode

_Function = TypeVar("_Function", bound=Callable[..., Any])


class CudaAsCpu(TorchFunctionMode):
    """Context in which torch uses the CPU for the device `cuda`, also in `tensor.cuda()` and `tensor.to("cuda")`."""

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        """Call a function of torch with the CPU in the place of `cuda`."""
        named = dict(kwargs or {})
        if func is torch.Tensor.cuda:
            return args[0]
        if _is_cuda(named.get("device")):
            named["device"] = torch.device("cpu")
        if func is torch.Tensor.to:
            args = (args[0], *(torch.device("cpu") if _is_cuda(value) else value for value in args[1:]))
        return func(*args, **named)


def on_cpu(function: _Function) -> _Function:
    """Return a function that runs in the context `CudaAsCpu`."""

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        with CudaAsCpu():
            return function(*args, **kwargs)

    return call  # type: ignore[return-value]


def _is_cuda(device: Any) -> bool:
    return (isinstance(device, torch.device) and device.type == "cuda") or (
        isinstance(device, str) and device.partition(":")[0] == "cuda"
    )

"""What the machine offers this process."""

from __future__ import annotations

import os

from rlcli.errors import DeviceError


def available_cores() -> int:
    """Cores this process may use; processes that a launcher started together share them."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


def require_device(device: str) -> None:
    """Refuse a device that torch cannot use here.

    Raises:
        DeviceError: for anything but cpu and a CUDA device that is there.
    """
    kind, _, index = device.partition(":")
    if kind == "cpu":
        return
    if kind != "cuda" or not (index or "0").isdecimal():
        raise DeviceError(f"device '{device}' is not available: there are engines for cpu, cuda and cuda:N")
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if int(index or 0) >= count:
        found = f"{count} CUDA devices" if count else "no CUDA device"
        message = f"device '{device}' is not available: torch {torch.__version__} sees {found}"
        raise DeviceError(message, hint="--device cpu")

"""Devices that torch can use on this machine."""

import re
import shutil
from importlib.util import find_spec
from pathlib import Path

from rlcli.errors import DependencyError, DeviceError, UsageError, pip_install


def require_device(device: str) -> None:
    """Check that torch can use a device, such as `cuda:0`, on this machine.

    Raises:
        DeviceError: for any device except cpu and an existing CUDA device.
    """
    kind, _, index = device.partition(":")
    if kind == "cpu":
        return
    if kind != "cuda" or not (index or "0").isdecimal():
        raise DeviceError(f"device '{device}' is not available; use cpu, cuda or cuda:N")
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if int(index or 0) >= count:
        found = f"{count} CUDA device{'s' * (count > 1)}" if count else "no CUDA device"
        message = f"device '{device}' is not available: torch {torch.__version__} finds {found}"
        raise DeviceError(message, hint=f"use --device cuda:N with N below {count}" if count else "use --device cpu")


def choose_device(wanted: str) -> str:
    """Return the torch device for the value of `--device`: auto, cpu, cuda or cuda:N.

    auto means the GPU if torch finds one and MuJoCo Warp is installed.

    Raises:
        UsageError: for any other value.
        DeviceError: if the device does not exist.
        DependencyError: for a GPU if rlcli[gpu] is not installed.
    """
    if wanted == "cpu" or (wanted == "auto" and not has_gpu_driver()):  # without a driver torch is not imported
        return "cpu"
    if wanted == "auto":
        import torch

        return "cuda" if torch.cuda.is_available() and find_spec("mujoco_warp") else "cpu"
    if not re.fullmatch(r"cuda(:[0-9]+)?", wanted):
        raise UsageError(f"no device '{wanted}'", hint="use auto, cpu, cuda or cuda:N")
    require_device(wanted)
    if find_spec("mujoco_warp") is None:
        raise DependencyError("the GPU engine needs mujoco-warp", hint=pip_install("rlcli[gpu]"))
    return wanted


def has_gpu_driver() -> bool:
    """Return whether an NVIDIA driver is installed (in WSL: the driver of Windows), without importing torch."""
    files = ("/proc/driver/nvidia", "/dev/nvidiactl", "/dev/dxg")
    return shutil.which("nvidia-smi") is not None or any(Path(file).exists() for file in files)

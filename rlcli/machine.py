"""What the machine offers this process."""

from __future__ import annotations

import contextlib
import errno
import gc
import hashlib
import os
import platform
import re
import shutil
import stat
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

from rlcli.errors import DependencyError, DeviceError, UsageError

_GROUPS, _OWN_GROUP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
_NO_LIMIT = 1 << 60
"""Version 1 says with a number like this that there is none."""


def available_cores(groups: Path = _GROUPS, own: Path = _OWN_GROUP) -> int:
    """Cores this process may use: its affinity, and no more than its control group grants it whole.

    Processes that a launcher started together share them.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = core_quota(groups, own)
    if quota is not None:  # a thread more is stopped for the rest of every period, and the others wait for it
        cores = min(cores, int(quota))
    return max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


def core_quota(groups: Path = _GROUPS, own: Path = _OWN_GROUP) -> float | None:
    """Cores' worth of time that a container's control group grants this process; None where there is no limit."""
    quotas = [_quota(folder) for folder in _control_groups("cpu", groups, own)]
    return min((quota for quota in quotas if quota is not None), default=None)


def memory_limit(groups: Path = _GROUPS, own: Path = _OWN_GROUP) -> int | None:
    """Bytes that a container's control group grants; None where there is no limit."""
    limits = []
    for folder in _control_groups("memory", groups, own):
        for name in ("memory.max", "memory.limit_in_bytes"):
            try:
                limits.append(int((folder / name).read_text(encoding="utf-8")))
            except (OSError, ValueError):  # not there, or `max`
                continue
    return min((limit for limit in limits if limit < _NO_LIMIT), default=None)


def _control_groups(controller: str, groups: Path, own: Path) -> Iterator[Path]:
    """The folders of this process's control groups, from its own up."""
    try:
        places = [line.split(":", 2) for line in own.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError):
        return
    for _, controllers, place in (parts for parts in places if len(parts) == 3):
        if controllers and controller not in controllers.split(","):
            continue
        # version 1 has a folder a controller, which may be mounted under either name; version 2 has none
        for root in (groups / controllers, groups / controller) if controllers else (groups,):
            folder = root / place.strip("/")
            yield from (each for each in (folder, *folder.parents) if each.is_relative_to(root))


def read_plain(file: Path, most: int) -> bytes:
    """What a plain file holds; a pipe or a device in its place is not waited for.

    Raises:
        OSError: if it is missing, is not a plain file, or is larger than `most` bytes.
    """
    descriptor = os.open(file, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with open(descriptor, "rb") as opened:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OSError(errno.EINVAL, "it is not a plain file", str(file))
        data = opened.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"larger than {most} bytes", str(file))
    return data


def memory(report: Path = Path("/proc/meminfo")) -> int:
    """Bytes of memory that this process may still ask for, as far as the system says; else half of what there is."""
    try:
        lines = report.read_text(encoding="utf-8").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, StopIteration, IndexError):
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    except (AttributeError, OSError, ValueError):
        return 8 * 2**30


def resident(report: Path = Path("/proc/self/statm")) -> int | None:
    """Bytes of memory that this process holds now; None where the system does not say."""
    try:
        return int(report.read_text(encoding="utf-8").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError, AttributeError):
        return None


def wait_calmly() -> None:
    """Threads of OpenMP spin briefly while they wait, unless somebody said how long; before torch is imported.

    On a busy machine libgomp's long spinning makes an update ten times slower.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")


_SELDOM = (100_000, 10, 10)
_usual: list[tuple[int, int, int]] = []


def collect_seldom() -> None:
    """Let Python look for cycles of garbage seldom, until `collect_as_usual`: for a process of our own that starts.

    Imports make hundreds of thousands of objects that stay; to look through them again and again takes a fifth of the
    time that torch takes to import.
    """
    _usual.append(gc.get_threshold())
    gc.set_threshold(*_SELDOM)


def collect_as_usual() -> None:
    """End what `collect_seldom` began, if it did, once what is large has been imported.

    What there is by then stays to the end, and is not looked through again: neither now nor when the process ends.
    """
    if _usual:
        gc.freeze()
        gc.set_threshold(*_usual.pop())


def _quota(group: Path) -> float | None:
    try:
        if (group / "cpu.max").is_file():
            limit, period = (group / "cpu.max").read_text(encoding="utf-8").split()
        else:
            limit, period = ((group / f"cpu.cfs_{name}_us").read_text(encoding="utf-8") for name in ("quota", "period"))
        return int(limit) / int(period) if limit != "max" and int(limit) > 0 else None
    except (OSError, ValueError, ZeroDivisionError):
        return None


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


def choose_device(wanted: str) -> str:
    """Return the torch device for auto, cpu, cuda or cuda:N; auto is the GPU if it can be used.

    Raises:
        UsageError: for something else.
        DeviceError: for a device that is not there.
        DependencyError: for a GPU without rlcli[gpu].
    """
    if wanted == "cpu" or (wanted == "auto" and not _may_have_gpu()):
        return "cpu"
    if wanted == "auto":
        import torch

        return "cuda" if torch.cuda.is_available() and find_spec("mujoco_warp") else "cpu"
    if not re.fullmatch(r"cuda(:[0-9]+)?", wanted):
        raise UsageError(f"no device '{wanted}'", hint="auto, cpu, cuda or cuda:N")
    require_device(wanted)
    if find_spec("mujoco_warp") is None:
        raise DependencyError("the GPU engine needs mujoco-warp", hint='pip install "rlcli[gpu]"')
    return wanted


def _may_have_gpu() -> bool:
    """Whether a driver is installed; torch is not imported for that."""
    return (
        Path("/dev/nvidiactl").exists()
        or Path("/proc/driver/nvidia").exists()
        or shutil.which("nvidia-smi") is not None
    )


def processor(info: Path = Path("/proc/cpuinfo")) -> dict[str, str]:
    """The processor's model and the hash of what it can do: libraries choose their kernels by both."""
    entries: dict[str, str] = {}
    with contextlib.suppress(OSError), info.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            key, colon, value = line.partition(":")
            if not colon:
                break  # the first core's block is over
            entries[key.strip()] = value.strip()
    model = entries.get("model name") or platform.processor() or platform.machine()
    flags = sorted((entries.get("flags") or entries.get("Features") or "").split())
    kernels = [flag for flag in flags if re.match(r"avx|fma|sse4|amx|sve|asimd|neon|f16c", flag)]
    record = {"model": model, "kernels": " ".join(kernels)}
    return record | ({"flags": hashlib.sha256(" ".join(flags).encode()).hexdigest()} if flags else {})


def has_onednn() -> bool:
    """Return whether torch was built with oneDNN."""
    import torch

    return bool(torch.backends.mkldnn.is_available())  # type: ignore[no-untyped-call]  # torch has no type here

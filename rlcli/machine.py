"""Resources of the machine that this process may use (cores, memory, devices), and settings of its libraries."""

import contextlib
import errno
import gc
import hashlib
import logging
import os
import platform
import re
import select
import shutil
import stat
import sys
from collections.abc import Iterator, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

from rlcli.errors import (
    DependencyError,
    DeviceError,
    MachineError,
    RlcliError,
    UsageError,
    error_text,
    one_line,
    pip_install,
)
from rlcli.safe_text import read_number

_log = logging.getLogger(__name__)

_GROUPS, _OWN_GROUP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
_NO_LIMIT = 1 << 60
"""Memory limits [bytes] from this number on mean "no limit": version 1 of control groups writes about 2**63."""


def available_cores(groups: Path = _GROUPS, own: Path = _OWN_GROUP) -> int:
    """Return the number of cores that this process may use.

    These are the cores of its CPU affinity, limited by the quota of its control group (rounded down). If a launcher
    such as torchrun started several processes, they share the cores equally.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = core_quota(groups, own)
    if quota is not None:  # a thread above the quota is paused for the rest of each period, and the others wait for it
        cores = min(cores, int(quota))
    return max(1, cores // launcher_number("LOCAL_WORLD_SIZE", 1, least=1))


def launcher_number(name: str, default: int, least: int = 0) -> int:
    """Return the number in an environment variable that a launcher such as torchrun sets; `default` if it is not set.

    Raises:
        UsageError: if the variable is not a whole number, or is below `least`.
    """
    text = os.environ.get(name) or str(default)
    number = read_number(text)
    if not isinstance(number, int) or number < least:
        message = f"the environment variable {name} is '{text}', not a whole number >= {least}"
        raise UsageError(message, hint=f"unset {name}; only launchers such as torchrun set it")
    return number


def core_quota(groups: Path = _GROUPS, own: Path = _OWN_GROUP) -> float | None:
    """Return the CPU quota of this process's control group in cores, for example 1.5; None if there is no limit."""
    quotas = [_quota(folder) for folder in _control_groups("cpu", groups, own)]
    return min((quota for quota in quotas if quota is not None), default=None)


def memory_limit(groups: Path = _GROUPS, own: Path = _OWN_GROUP) -> int | None:
    """Return the memory limit of this process or its control group [bytes]; None if there is no limit."""
    limits = [address_space() or _NO_LIMIT]
    for folder in _control_groups("memory", groups, own):
        for name in ("memory.max", "memory.limit_in_bytes"):
            try:
                limits.append(int((folder / name).read_text(encoding="utf-8")))
            except (OSError, ValueError):  # the file is missing, or holds the word `max`
                continue
    return min((limit for limit in limits if limit < _NO_LIMIT), default=None)


def _control_groups(controller: str, groups: Path, own: Path) -> Iterator[Path]:
    """Yield the folders of this process's control groups (Linux), from its own group up to the root group.

    Args:
        controller: cpu or memory.
        groups: folder of all groups.
        own: file that names the process's own group.
    """
    try:
        lines = [line.split(":", 2) for line in own.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError):
        return
    for _, controllers, path in (parts for parts in lines if len(parts) == 3):
        if controllers and controller not in controllers.split(","):
            continue
        # version 1 has one folder for each controller, mounted under either name; version 2 has one tree for all
        for root in (groups / controllers, groups / controller) if controllers else (groups,):
            folder = root / path.strip("/")
            yield from (each for each in (folder, *folder.parents) if each.is_relative_to(root))


def python_command(*arguments: str) -> list[str]:
    """Return the command that starts this Python with arguments, so that it imports nothing from the current folder."""
    return [sys.executable, "-P", *arguments]


_PIPE_S = 10.0
"""Time to wait for the first byte of a pipe [s]."""


def read_plain(file: Path, most: int, *, pipe: bool = False) -> bytes:
    """Return the content of a regular file. A device at this path is refused without blocking.

    Args:
        file: the file.
        most: largest size of the file [bytes].
        pipe: whether the file may be a pipe, as a shell creates it for `--config <(...)`.

    Raises:
        OSError: if the file is missing, is not a regular file, is larger than `most` bytes, or if a pipe stays empty
            for 10 s.
    """
    descriptor = os.open(file, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    with open(descriptor, "rb") as opened:
        mode = os.fstat(descriptor).st_mode
        if not (stat.S_ISREG(mode) or (pipe and stat.S_ISFIFO(mode))):
            raise OSError(errno.EINVAL, "it is not a regular file", str(file))
        if stat.S_ISFIFO(mode):
            if not select.select([descriptor], [], [], _PIPE_S)[0]:
                raise OSError(errno.EAGAIN, f"nothing was written to the pipe in {_PIPE_S:g} s", str(file))
            os.set_blocking(descriptor, True)
        data: bytes | None = opened.read(most + 1)
        if data is None:  # files such as /proc/kmsg
            raise OSError(errno.EAGAIN, "the system gives no content of this file now", str(file))
    if len(data) > most:
        raise OSError(errno.EFBIG, f"the file is larger than {most} bytes, the most that rlcli reads", str(file))
    return data


def available_memory(report: Path = Path("/proc/meminfo")) -> int:
    """Return the memory of the machine that is still available [bytes]; `memory_limit` returns limits of the process.

    The value is `MemAvailable` of Linux; else half of the machine's memory; else 8 GiB.
    """
    try:
        lines = report.read_text(encoding="utf-8").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, StopIteration, IndexError):
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    except (AttributeError, OSError, ValueError):
        return 8 * 2**30


def memory_error(error: BaseException | None) -> MachineError | None:
    """Return the error to show if an exception, or one of its causes, means that memory was too small; else None."""
    limit = address_space()
    limited = f" (the process is limited to {limit >> 20} MiB)" if limit else ""
    while error is not None:
        text = error_text(error)
        if isinstance(error, MemoryError) or (
            not isinstance(error, RlcliError) and (_NO_MEMORY.search(text) or (limit and _UNDER_A_LIMIT.search(text)))
        ):
            sizes = "scene.num_envs, or the sizes of networks and histories"
            hint = f"close other programs, raise the limit of the process (`ulimit -v`), or lower {sizes}"
            return MachineError(f"too little memory{limited}: {one_line(error, 200)}", hint=hint)
        error = error.__cause__ or error.__context__
    return None


def address_space() -> int | None:
    """Return the limit that `ulimit -v` sets for this process [bytes]; None if there is no limit."""
    with contextlib.suppress(ImportError):  # Windows
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        return limit if 0 < limit < _NO_LIMIT else None
    return None


def require_address_space(least: int = 1 << 30) -> None:
    """Check that a limit such as `ulimit -v` leaves enough memory to load large libraries.

    Otherwise the libraries would end the process without a message.

    Args:
        least: the limit that the libraries need [bytes]. The default is for torch and MuJoCo.

    Raises:
        MachineError: if the limit is lower.
    """
    if (limit := address_space()) is not None and limit < least:
        message = f"the process is limited to {limit >> 20} MiB of memory; {least >> 20} are needed"
        raise MachineError(message, hint="raise the limit, for example with `ulimit -v unlimited`")


def require_memory(size: int, what: str) -> None:
    """Check that enough memory is free. Without this check, the system may kill the process later.

    Log a warning if a large part of the free memory is needed, because `size` is only a lower bound.

    Args:
        size: the memory [bytes].
        what: what needs the memory, for the message.

    Raises:
        DeviceError: if less memory is free.
    """
    free = min(available_memory(), memory_limit() or _NO_LIMIT)
    if size > free:
        message = f"{what} need at least {size / 2**30:.1f} GiB, {free / 2**30:.1f} GiB are free on this machine"
        raise DeviceError(message, hint="use fewer environments: --num-envs")
    if size > free / 4:
        _log.warning(f"{what} need at least {size / 2**30:.1f} GiB of the {free / 2**30:.1f} GiB that are free")


class AddressSpaceCheck:
    """Import hook that calls `require_address_space` before a large library is imported."""

    @staticmethod
    def find_spec(name: str, *_: object) -> None:
        """Check the limit for a large library, and return None: the next finder of `sys.meta_path` finds the module.

        Raises:
            MachineError: if the limit is too low for this library.
        """
        if name in ("numpy", "mujoco", "torch"):
            require_address_space()


class MatplotlibFinder:
    """Import hook that imports matplotlib with its own folder as the current folder.

    matplotlib reads a file `matplotlibrc` of the current folder, which may be a pipe or belong to someone else.
    """

    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None = None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Return the specification of matplotlib; None for other modules."""
        spec = PathFinder.find_spec(name, path, target) if name == "matplotlib" else None
        if spec is None or spec.loader is None or spec.origin is None:
            return None
        execute, folder = spec.loader.exec_module, Path(spec.origin).parent / "mpl-data"

        def execute_in_folder(module: ModuleType) -> None:
            with contextlib.chdir(folder):
                execute(module)

        spec.loader.exec_module = execute_in_folder  # type: ignore[method-assign]
        return spec


_NO_MEMORY = re.compile(
    r"(not|n't) allocate memory|not enough memory|bad_alloc|failed to map segment|n't start new thread|unable to mmap"
    r"|out of memory",
    re.IGNORECASE,
)
"""Messages about too little memory of MuJoCo, torch, the dynamic linker and Python; their classes differ."""
_UNDER_A_LIMIT = re.compile(r"failed to load the shared library|framebuffer is not complete", re.IGNORECASE)
"""Messages of Warp and OpenGL that can have other causes; with a limit on the memory they mean too little memory."""


def resident_memory(report: Path = Path("/proc/self/statm")) -> int | None:
    """Return the memory that this process occupies now [bytes]; None if the system does not report it."""
    try:
        return int(report.read_text(encoding="utf-8").split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError, AttributeError):
        return None


def limit_openmp_spinning() -> None:
    """Let OpenMP threads spin only briefly while they wait, unless the user set GOMP_SPINCOUNT.

    Call it before torch is imported. On a busy machine libgomp's long spinning makes an update ten times slower.
    """
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")


_SELDOM = (100_000, 10, 10)
"""Thresholds of `gc.set_threshold` with which collections are rare."""
_saved_thresholds: list[tuple[int, int, int]] = []


def delay_garbage_collection() -> None:
    """Make Python's cyclic garbage collection rare until `restore_garbage_collection` is called.

    The command line calls it at its start. Imports create hundreds of thousands of objects that stay in memory;
    scanning them again and again takes a fifth of the time of importing torch.
    """
    _saved_thresholds.append(gc.get_threshold())
    gc.set_threshold(*_SELDOM)


def restore_garbage_collection() -> None:
    """Undo `delay_garbage_collection`, if it was called, after the large libraries have been imported.

    The objects that exist now are excluded from all later collections, also from the one at the end of the process.
    """
    if _saved_thresholds:
        gc.freeze()
        gc.set_threshold(*_saved_thresholds.pop())


def _quota(group: Path) -> float | None:
    """Return the CPU quota of the control group with this folder, in cores; None if the group sets no quota."""
    try:
        if (group / "cpu.max").is_file():
            limit, period = (group / "cpu.max").read_text(encoding="utf-8").split()
        else:
            limit, period = ((group / f"cpu.cfs_{name}_us").read_text(encoding="utf-8") for name in ("quota", "period"))
        return int(limit) / int(period) if limit != "max" and int(limit) > 0 else None
    except (OSError, ValueError, ZeroDivisionError):
        return None


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
        raise DeviceError(message, hint="use --device cpu")


def choose_device(wanted: str) -> str:
    """Return the torch device for the value of `--device`: auto, cpu, cuda or cuda:N.

    auto means the GPU if torch and MuJoCo Warp can use it.

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
    """Return whether an NVIDIA driver is installed (in WSL: that of Windows), without importing torch."""
    files = ("/proc/driver/nvidia", "/dev/nvidiactl", "/dev/dxg")
    return shutil.which("nvidia-smi") is not None or any(Path(file).exists() for file in files)


def processor(info: Path = Path("/proc/cpuinfo")) -> dict[str, str]:
    """Return the processor's `model`, its vector instruction sets (`kernels`) and a hash of all its `flags`.

    Math libraries choose their kernels by these, so results may differ in the last bits between two processors.
    """
    entries: dict[str, str] = {}
    with contextlib.suppress(OSError), info.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            key, colon, value = line.partition(":")
            if not colon:
                break  # an empty line: the block of the first core ends here
            entries[key.strip()] = value.strip()
    model = entries.get("model name") or platform.processor() or platform.machine()
    flags = sorted((entries.get("flags") or entries.get("Features") or "").split())
    kernels = [flag for flag in flags if re.match(r"avx|fma|sse4|amx|sve|asimd|neon|f16c", flag)]
    record = {"model": model, "kernels": " ".join(kernels)}
    return record | ({"flags": hashlib.sha256(" ".join(flags).encode()).hexdigest()} if flags else {})


def has_onednn() -> bool:
    """Return whether torch can use oneDNN, a library with fast CPU kernels."""
    import torch

    return bool(torch.backends.mkldnn.is_available())  # type: ignore[no-untyped-call]  # torch has no type here


@contextlib.contextmanager
def native_stderr_discarded() -> Iterator[None]:
    """Discard what C code writes to stderr (file descriptor 2) in the `with` block, such as messages at its start."""
    with contextlib.ExitStack() as stack:
        try:
            kept = os.dup(2)
        except OSError:  # file descriptor 2 is closed
            kept = -1
        if kept >= 0:
            stack.callback(os.close, kept)
            stack.callback(os.dup2, kept, 2)
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 2)
            os.close(nowhere)
        yield

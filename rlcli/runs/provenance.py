"""Record the software and hardware of a run, which may change its results: versions, source code, processor, threads.

The record is stored in run.json; `rlcli diff` and `rlcli reproduce` compare it with that of another run or machine.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import platform
import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rlcli
from rlcli.errors import TaskError
from rlcli.machine.processor import has_onednn, processor
from rlcli.registry import TRAINERS, find_entry, is_framework, model_file, package_folder

if TYPE_CHECKING:
    import mujoco

    from rlcli.config.load import Resolved

PACKAGES = ("mujoco", "torch", "numpy", "stable-baselines3", "safetensors")
VARIABLES = (
    "ATEN_CPU_CAPABILITY", "CUBLAS_WORKSPACE_CONFIG", "DNNL_MAX_CPU_ISA", "GLIBC_TUNABLES",
    "KMP_DETERMINISTIC_REDUCTION", "MKL_CBWR", "MKL_DEBUG_CPU_TYPE", "MKL_DYNAMIC", "MKL_ENABLE_INSTRUCTIONS",
    "MKL_NUM_THREADS", "NVIDIA_TF32_OVERRIDE", "NPY_DISABLE_CPU_FEATURES", "OMP_DYNAMIC", "OMP_NUM_THREADS",
    "OMP_SCHEDULE", "OMP_THREAD_LIMIT", "ONEDNN_DEFAULT_FPMATH_MODE", "ONEDNN_MAX_CPU_ISA", "OPENBLAS_CORETYPE",
    "TORCH_ALLOW_TF32_CUBLAS_OVERRIDE",
)  # fmt: skip
"""Environment variables that select kernels or the order of sums. Other variables are not recorded."""
ENTRIES = (
    "rlcli", "python", "machine", "libc", "versions", "sources", "cpu", "variables", "engine_threads", "torch_threads",
    "device", "processes", "torch", "model",
)  # fmt: skip
"""Entries of run.json that `differences` compares. The others (command, pid, platform, times) do not affect results."""

_ASSETS = re.compile(rb"""\bfile\s*=\s*["']([^"']{1,500})["']""")
_FOLDERS = re.compile(rb"""\b(?:meshdir|texturedir|assetdir)\s*=\s*["']([^"']{0,500})["']""")
_MAX_FILES = 256
_MAX_BYTES = 64 * 1024**2
"""Limit of the total size of a task's files that are hashed [bytes]. The hash of the compiled model covers the rest."""


def environment_record(resolved: Resolved, engine_threads: int, torch_threads: int) -> dict[str, Any]:
    """Return the entries of run.json that are known before the environment is built; `built_record` returns the others.

    The function imports neither torch nor MuJoCo.

    Args:
        resolved: configuration of the task and the agent.
        engine_threads: number of CPU threads of the physics.
        torch_threads: number of CPU threads of torch.
    """
    return {
        "rlcli": rlcli.__version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "machine": platform.machine(),
        "libc": " ".join(platform.libc_ver()).strip(),  # torch and MuJoCo call functions of the C library, such as sin
        "versions": versions(resolved),
        "sources": sources(resolved),
        "cpu": processor(),
        "variables": {name: os.environ[name] for name in VARIABLES if name in os.environ},
        "engine_threads": engine_threads,
        "torch_threads": torch_threads,
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "pid": os.getpid(),
    }


def built_record(model: mujoco.MjModel, device: str) -> dict[str, Any]:
    """Return the entries of run.json that need the built environment.

    Returns:
        `torch` (settings of torch that change rounding, GPU) and `model` (hash of the compiled model).
    """
    import torch

    denormal = torch.tensor([1e-310], dtype=torch.float64)
    settings: dict[str, Any] = {
        "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        "mkl": torch.backends.mkl.is_available(),  # type: ignore[no-untyped-call]  # torch has no type here
        "onednn": has_onednn() and bool(torch.backends.mkldnn.enabled),
        "matmul_precision": torch.get_float32_matmul_precision(),
        "deterministic": torch.are_deterministic_algorithms_enabled(),
        "flush_denormal": float(denormal * 1.0) == 0.0,
    }
    if device != "cpu":
        settings["gpu"] = torch.cuda.get_device_name(device)
        settings["cuda"] = torch.version.cuda
        settings["cudnn"] = torch.backends.cudnn.version()  # type: ignore[no-untyped-call]  # torch has no type here
    return {"torch": settings, "model": model_digest(model)}


def versions(resolved: Resolved) -> dict[str, str]:
    """Return the versions of all packages that may change the results, by the name of the package.

    The packages are `PACKAGES`, those of the task, of the trainer and of the task's format, and their requirements. A
    package that is not installed has an empty version.
    """
    found = {name: _version(name) for name in PACKAGES}
    owners = []
    if resolved.source.distribution:
        owners.append(resolved.source.distribution)
    if resolved.agent is not None and resolved.trainer and not is_framework(resolved.trainer.trainer):
        with contextlib.suppress(TaskError):
            owners.append(find_entry(TRAINERS, resolved.agent.trainer, what="trainer").distribution)
    if resolved.format is not None:
        owners.append(resolved.format.entry.distribution)
    for owner in owners:
        if owner.lower() == "rlcli" or owner in found:
            continue
        found[owner] = _version(owner)
        for name in _requirements(owner):
            if name.lower() != "rlcli" and (version := _version(name)):
                found.setdefault(name, version)
    return found


def sources(resolved: Resolved) -> dict[str, str]:
    """Return SHA-256 hashes by name: of each file of the task, and of the code of rlcli and of the task's format."""
    root = resolved.source.root.resolve()
    digests = {}
    for file in _task_files(resolved):
        if digest := file_digest(file):
            digests[_label(file, root)] = digest
    packages = {"rlcli": _sources_digest(Path(rlcli.__file__).parent)}
    folder = package_folder(resolved.format.entry) if resolved.format is not None else None
    if folder is not None:
        packages[folder.name] = _sources_digest(folder)
    return packages | dict(sorted(digests.items()))


def file_digest(file: Path) -> str | None:
    """Return the sha256 of a file; None if it cannot be read."""
    try:
        with file.open("rb") as handle:
            return hashlib.file_digest(handle, "sha256").hexdigest()
    except OSError:
        return None


def model_digest(model: mujoco.MjModel) -> str:
    """Return the SHA-256 of a compiled model's numbers, except for textures, materials, skins and file paths."""
    import numpy as np

    digest = hashlib.sha256()
    for name in sorted(vars(type(model))):
        if name.startswith(("_", "tex_", "paths", "mat_", "vis", "skin_")):
            continue
        value = getattr(model, name, None)
        if isinstance(value, np.ndarray):
            digest.update(f"{name}{value.dtype}{value.shape}".encode())
            digest.update(np.ascontiguousarray(value).tobytes())
    for name in sorted(vars(type(model.opt))):
        value = getattr(model.opt, name, None)
        if isinstance(value, int | float | np.ndarray):
            digest.update(name.encode() + np.asarray(value).tobytes())
    return digest.hexdigest()


def differences(was: Mapping[str, Any], now: Mapping[str, Any]) -> list[tuple[str, Any, Any]]:
    """Return (dotted name, old value, new value) of each entry whose values differ between two records.

    Entries of `ENTRIES` that a record lacks are not compared.

    Args:
        was: a record of this module, such as the record of a run.
        now: the record to compare with it.
    """
    rows = []
    for entry in ENTRIES:
        if entry not in was or entry not in now:
            continue
        before, after = _flat(entry, was[entry]), _flat(entry, now[entry])
        names = dict.fromkeys([*before, *after])
        rows += [(name, before.get(name), after.get(name)) for name in names if before.get(name) != after.get(name)]
    return rows


def _flat(name: str, value: object) -> dict[str, Any]:
    if not isinstance(value, dict):
        return {name: value}
    return {f"{name}.{key}": item for key, item in value.items()}


def _task_files(resolved: Resolved) -> Iterator[Path]:
    """Yield the task's Python files, its models and their assets, but not its YAML, which the run stores itself."""
    source = resolved.source
    pending = [*source.term_files, *([source.task_file] if source.task_file else []), *sorted(source.root.glob("*.py"))]
    for entity in resolved.task.scene.entities.values():
        model = getattr(entity, "model", None)
        if isinstance(model, str):
            with contextlib.suppress(TaskError):
                pending.append(model_file(source.root, model))
    seen: set[Path] = set()
    left = _MAX_BYTES
    while pending and len(seen) < _MAX_FILES:
        file = pending.pop(0)
        with contextlib.suppress(OSError, ValueError):
            file = file.resolve()
            size = file.stat().st_size
            if file in seen or not file.is_file() or size > left:
                continue
            seen.add(file)
            left -= size
            yield file
            if file.suffix == ".xml":
                pending += _assets_of(file)


def _assets_of(model: Path) -> Iterable[Path]:
    """Return paths of files that an MJCF may refer to: each asset's name in the MJCF's folder and its asset folders."""
    text = model.read_bytes()
    folders = ["", *(os.fsdecode(name) for name in _FOLDERS.findall(text))]
    names = dict.fromkeys(os.fsdecode(name) for name in _ASSETS.findall(text))
    return [model.parent / folder / name for name in names for folder in folders]


def _sources_digest(package: Path) -> str:
    digest = hashlib.sha256()
    for folder, folders, files in os.walk(package):
        folders.sort()
        for name in sorted(files):
            if name.endswith(".py"):
                file = os.path.join(folder, name)
                digest.update(os.path.relpath(file, package).replace(os.sep, "/").encode() + b"\0")
                with contextlib.suppress(OSError), open(file, "rb") as handle:
                    digest.update(handle.read())
    return digest.hexdigest()


def _label(file: Path, root: Path) -> str:
    if file.is_relative_to(root):
        return file.relative_to(root).as_posix()
    return f"{file.parent.name}/{file.name}"


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


def _requirements(distribution: str) -> list[str]:
    with contextlib.suppress(metadata.PackageNotFoundError):
        lines = metadata.requires(distribution) or []
        found = [re.match(r"[A-Za-z0-9][\w.-]*", line) for line in lines if "extra ==" not in line]
        return [match[0] for match in found if match]
    return []

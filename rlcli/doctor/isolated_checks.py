"""What is asked in processes of its own, because it may hang or crash: torch and MuJoCo, OpenGL, GPU drivers."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from rlcli.doctor.check import Check
from rlcli.doctor.installation import TRIPLE, version
from rlcli.errors import MachineError
from rlcli.machine import available_cores
from rlcli.sim.gl import candidates

LOW_SHARED_BYTES = 512e6
"""Of /dev/shm: NCCL, which joins several GPUs, puts its buffers there; Docker gives 64 MB unless told otherwise."""
_PACKAGES = "apt install libegl1 libosmesa6"
_OFF = ("disable", "disabled", "off", "false", "0")
_ANSWER_BYTES = 100_000
_LATE = "no answer within"
BUSY = "if the machine is busy: rlcli doctor --probe-timeout 120"
REINSTALL = f"pip uninstall -y {' '.join(TRIPLE)} && pip install mujoco"
"""One after the other: installing over older packages removes files that the newer ones have just written."""

Answer = tuple[dict[str, Any] | None, str]
"""What a process answered; or None and why there is no answer."""


def check_isolated(timeout_s: float) -> list[Check]:
    """torch, MuJoCo, graphics and GPUs."""
    backends = ["cgl", "glfw"] if sys.platform == "darwin" else ["egl", "osmesa", "glfw"]
    with ThreadPoolExecutor(available_cores()) as pool:
        compute = pool.submit(run_isolated, "compute", timeout_s)
        drawn = {name: pool.submit(run_isolated, name, timeout_s) for name in backends}
        isolated = run_isolated("gpu", timeout_s) if _has_driver() else None
        graphics = graphics_check({name: answer.result() for name, answer in drawn.items()})
        return [*compute_checks(*compute.result()), *gpu_checks(isolated), graphics]


def compute_checks(answer: dict[str, Any] | None, reason: str) -> list[Check]:
    """Whether torch and MuJoCo can be imported, and compute."""
    if answer is None:
        hint = REINSTALL if "mujoco" in reason.lower() else "pip install --upgrade --force-reinstall torch"
        hint = BUSY if reason.startswith(_LATE) else hint
        return [Check("torch", "broken", f"torch and mujoco do not work: {reason}", hint)]
    build = f"{answer['torch']}, built for {'CUDA ' + answer['cuda'] if answer['cuda'] else 'the CPU'}"
    checks = [Check("torch", "ok", f"{build}, {answer['threads']} threads", details=answer)]
    library, package = answer["mujoco"], answer["mujoco_package"]
    if package is not None and package != library:
        said = f"the package says {package}, the library that is loaded says {library}"
        checks.append(Check("mujoco", "broken", said, REINSTALL))
    else:
        checks.append(Check("mujoco", "ok", f"{library}, the CPU engine steps"))
    before, after = answer["cores"]
    if after < before:
        said = f"once torch has computed, its OpenMP keeps the process on {after} of {before} cores"
        names = [n for n in ("OMP_PROC_BIND", "OMP_PLACES", "GOMP_CPU_AFFINITY", "KMP_AFFINITY") if n in os.environ]
        checks.append(Check("pinning", "warning", said, f"unset {' '.join(names) or 'OMP_PROC_BIND'}"))
    return checks


def gpu_checks(isolated: Answer | None) -> list[Check]:
    """Whether driver, torch and Warp fit together; None: there is no driver."""
    if isolated is None:
        return [Check("gpu", "ok", "none; the CPU engine needs none")]
    answer, reason = isolated
    if answer is None:
        return [Check("gpu", "warning", f"there is a driver, but asking it failed: {reason}", "nvidia-smi")]
    driver, cuda, warp = answer["driver_cuda"], answer["torch_cuda"], answer["warp"]
    failed, warp_package = answer["torch_error"], version("mujoco-warp")
    said, hint = f"{', '.join(answer['devices'])}; driver CUDA {driver or '?'}, torch CUDA {cuda}", None
    if cuda is None:
        said = "there is a driver, but torch is built for the CPU"
        hint = "pip install --force-reinstall torch, with the index of https://pytorch.org that fits the driver"
    elif driver is not None and _release(cuda) > _release(driver):
        said = f"torch is built for CUDA {cuda}, the driver offers CUDA {driver}"
        hint = f"update the driver, or install a torch that is built for CUDA {_release(driver)} (https://pytorch.org)"
    elif not answer["devices"]:
        said = f"there is a driver, but torch sees no device{failed}"
        hint = "see whether nvidia-smi works; CUDA_VISIBLE_DEVICES hides devices"
    elif failed:
        said += f"; torch cannot compute there{failed}"
        hint = "install a torch that is built for this GPU (https://pytorch.org)"
    elif warp_package is None or warp is None:
        said += f"; without {'mujoco-warp' if warp_package is None else 'warp-lang'}"
        hint = 'pip install "rlcli[gpu]"'
    elif warp["error"] or not warp["devices"]:
        why = f": {warp['error']}" if warp["error"] else ", whose build may not fit the driver"
        said += f"; Warp {warp['version']} sees no GPU{why}"
        hint = "pip install --upgrade --force-reinstall warp-lang"
    else:
        said += f", Warp {warp['version']}, mujoco-warp {warp_package}"
    if hint is not None:
        return [Check("gpu", "warning", said, hint, answer)]
    checks = [Check("gpu", "ok", said, details=answer)]
    if len(answer["devices"]) > 1 and Path("/dev/shm").is_dir():
        checks.append(shared_memory_check(shutil.disk_usage("/dev/shm").free))
    return checks


def shared_memory_check(free: int) -> Check:
    """Whether /dev/shm has room for what several GPUs exchange."""
    found, details = f"{free / 1e6:.0f} MB free in /dev/shm", {"free_bytes": free}
    if free >= LOW_SHARED_BYTES:
        return Check("shared memory", "ok", found, details=details)
    return Check(
        "shared memory", "warning", f"{found}: too little for several GPUs", "docker run --shm-size=8g", details
    )


def graphics_check(answers: dict[str, Answer]) -> Check:
    """Which OpenGL draws a picture, and which one would be used."""
    works = [name for name, (answer, _) in answers.items() if answer is not None]
    fails = {name: reason for name, (answer, reason) in answers.items() if answer is None}
    said = f"{', '.join(works) or 'nothing'} can draw"
    said += "".join(f"; {name} cannot ({reason})" for name, reason in fails.items())
    details: dict[str, Any] = {"drawn": {name: name in works for name in answers}, "used": None}
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wanted in _OFF:
        return Check("graphics", "ok", f"switched off by MUJOCO_GL={wanted}; {said}", details=details)
    if wanted in answers and wanted not in works:
        return Check("graphics", "broken", f"MUJOCO_GL={wanted} cannot draw; {said}", "unset MUJOCO_GL", details)
    if wanted and wanted not in (*answers, *_KNOWN):
        found = f"MUJOCO_GL={wanted}, with which MuJoCo does not start; {said}"
        return Check("graphics", "broken", found, "unset MUJOCO_GL", details)
    if not works:
        late = any(reason.startswith(_LATE) for reason in fails.values())
        hint = BUSY if late else f"for videos: {_PACKAGES} (Debian, Ubuntu)"
        return Check("graphics", "warning", said, hint, details)
    with contextlib.suppress(MachineError):
        details["used"] = next((name for name in candidates() if name in works), None)
    used = f"; {details['used']} is used" if details["used"] else ""
    return Check("graphics", "ok", f"{said}{used}", details=details)


_KNOWN = ("enable", "enabled", "on", "true", "1", "glx", "wgl", "cgl")
"""Of MUJOCO_GL, beside the names of libraries: MuJoCo's own."""


def run_isolated(check_name: str, timeout_s: float) -> Answer:
    """The answer of another process, or None and why there is none."""
    command = [sys.executable, "-m", "rlcli.doctor", check_name]
    environment = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    try:
        done = subprocess.run(
            command, capture_output=True, timeout=timeout_s, stdin=subprocess.DEVNULL, env=environment
        )
    except subprocess.TimeoutExpired:
        return None, f"{_LATE} {timeout_s:g} s"
    with contextlib.suppress(ValueError, IndexError):
        answer = json.loads(done.stdout[-_ANSWER_BYTES:].splitlines()[-1])
        return (None, str(answer["failed"])) if "failed" in answer else (answer, "")
    lines = done.stderr.decode(errors="replace").strip().splitlines()
    if done.returncode < 0:
        with contextlib.suppress(ValueError):
            return None, f"crashed ({signal.Signals(-done.returncode).name})"
    return None, f"exit {done.returncode}" + (f": {lines[-1][:200]}" if lines else "")


def _has_driver() -> bool:
    places = ("/proc/driver/nvidia", "/dev/nvidiactl", "/dev/dxg")
    return shutil.which("nvidia-smi") is not None or any(Path(place).exists() for place in places)


def _release(text: str) -> int:
    """Return the first number of a version; 0 if there is none."""
    return next((int(part) for part in text.split(".")[:2] if part.isdecimal()), 0)

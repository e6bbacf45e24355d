"""Checks of torch, MuJoCo, OpenGL and GPU drivers, in separate processes, because a check may hang or crash."""

import contextlib
import json
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from rlcli.doctor.check import Check
from rlcli.doctor.installation import MUJOCO_PACKAGES, missing_requirement, version
from rlcli.errors import MachineError, install_hint, pip_install
from rlcli.machine.cores import available_cores
from rlcli.machine.devices import has_gpu_driver
from rlcli.machine.processes import python_command
from rlcli.registry.plugin_imports import release_numbers
from rlcli.registry.probe import signal_name
from rlcli.sim.gl import candidates

LOW_SHARED_BYTES = 512e6
"""Free space of /dev/shm below which several GPUs get a warning: NCCL keeps its buffers there. Docker's default is
64 MB."""
_PACKAGES = "apt install libegl1 libosmesa6"
_OFF = ("disable", "disabled", "off", "false", "0")
_ANSWER_BYTES = 100_000
_LATE = "no answer within"
BUSY = "if the machine is busy: `rlcli doctor --probe-timeout 120`"
REINSTALL = f"pip uninstall -y {' '.join(MUJOCO_PACKAGES)} && {pip_install('mujoco')}"
"""Command that repairs MuJoCo. It first uninstalls all three packages of MuJoCo: they share files, so an upgrade of one
package may remove files of another."""

Answer = tuple[dict[str, Any] | None, str]
"""Answer of a check in a separate process: its result as JSON data and "", or None and the reason of the failure."""


def check_isolated(timeout_s: float) -> list[Check]:
    """Run the checks of torch, MuJoCo, graphics and GPUs in separate processes; return their results."""
    backends = ["cgl", "glfw"] if sys.platform == "darwin" else ["egl", "osmesa", "glfw"]
    with ThreadPoolExecutor(available_cores()) as pool:
        compute = pool.submit(run_isolated, "compute", timeout_s)
        rendered = {name: pool.submit(run_isolated, name, timeout_s) for name in backends}
        gpu = run_isolated("gpu", timeout_s) if has_gpu_driver() else None
        graphics = graphics_check({name: answer.result() for name, answer in rendered.items()})
        return [*compute_checks(*compute.result()), *gpu_checks(gpu), graphics]


def compute_checks(answer: dict[str, Any] | None, reason: str) -> list[Check]:
    """Return the checks of torch and MuJoCo: both can be imported and compute, and do not reduce the number of cores.

    Args:
        answer: result of the separate process; None: the process failed.
        reason: why the process failed.
    """
    if answer is None:
        hint = REINSTALL if "mujoco" in reason.lower() else pip_install("--force-reinstall torch")
        missing = missing_requirement(reason)
        hint = BUSY if reason.startswith(_LATE) else install_hint(missing) if missing else hint
        return [Check("torch", "broken", f"a computation with torch and mujoco failed: {reason}", hint)]
    build = f"{answer['torch']}, built for {'CUDA ' + answer['cuda'] if answer['cuda'] else 'the CPU'}"
    checks = [Check("torch", "ok", f"{build}, {answer['threads']} threads", details=answer)]
    library, package = answer["mujoco"], answer["mujoco_package"]
    if package is not None and package != library:
        text = f"the package has version {package}, but the loaded library has version {library}"
        checks.append(Check("mujoco", "broken", text, REINSTALL))
    else:
        checks.append(Check("mujoco", "ok", f"{library}, a physics step works"))
    before, after = answer["cores"]
    if after < before:
        text = f"after torch has computed, its OpenMP keeps the process on {after} of {before} cores"
        names = [n for n in ("OMP_PROC_BIND", "OMP_PLACES", "GOMP_CPU_AFFINITY", "KMP_AFFINITY") if n in os.environ]
        checks.append(Check("pinning", "warning", text, f"unset {' '.join(names) or 'OMP_PROC_BIND'}"))
    return checks


def gpu_checks(gpu: Answer | None) -> list[Check]:
    """Return the checks of the GPU: its driver, torch and Warp fit together.

    Args:
        gpu: answer of the separate process, see `isolated_checks._gpu`; None: there is no GPU driver.
    """
    if gpu is None:
        return [Check("gpu", "ok", "no GPU driver; the CPU engine needs no GPU")]
    answer, reason = gpu
    if answer is None:
        return [Check("gpu", "warning", f"a driver is installed, but its check failed: {reason}", "run nvidia-smi")]
    driver, cuda, warp = answer["driver_cuda"], answer["torch_cuda"], answer["warp"]
    failure, warp_package = answer["torch_error"], version("mujoco-warp")
    text, hint = f"{', '.join(answer['devices'])}; driver CUDA {driver or '?'}, torch CUDA {cuda}", None
    if cuda is None:
        text = "a driver is installed, but torch is built for the CPU"
        hint = f"{pip_install('--force-reinstall torch')}, with the index of https://pytorch.org that fits the driver"
    elif driver is not None and _major(cuda) > _major(driver):
        text = f"torch is built for CUDA {cuda}, the driver supports CUDA {driver}"
        hint = f"update the driver, or install a torch that is built for CUDA {_major(driver)} (https://pytorch.org)"
    elif not answer["devices"]:
        text = f"a driver is installed, but torch finds no device{failure}"
        hint = "check whether nvidia-smi works; CUDA_VISIBLE_DEVICES hides devices"
    elif failure:
        text += f"; torch cannot compute on this GPU{failure}"
        hint = "install a torch that is built for this GPU (https://pytorch.org)"
    elif warp_package is None or warp is None:
        text += f"; {'mujoco-warp' if warp_package is None else 'warp-lang'} is not installed"
        hint = pip_install("rlcli[gpu]")
    elif warp["error"] or not warp["devices"]:
        cause = f": {warp['error']}" if warp["error"] else ", its build may not fit the driver"
        text += f"; Warp {warp['version']} finds no GPU{cause}"
        hint = pip_install("--force-reinstall warp-lang")
    else:
        text += f", Warp {warp['version']}, mujoco-warp {warp_package}"
    if hint is not None:
        return [Check("gpu", "warning", text, hint, answer)]
    checks = [Check("gpu", "ok", text, details=answer)]
    if len(answer["devices"]) > 1 and Path("/dev/shm").is_dir():
        checks.append(shared_memory_check(shutil.disk_usage("/dev/shm").free))
    return checks


def shared_memory_check(free: int) -> Check:
    """Check that /dev/shm has enough free space [bytes] for the buffers of several GPUs."""
    found, details = f"{free / 1e6:.0f} MB free in /dev/shm", {"free_bytes": free}
    if free >= LOW_SHARED_BYTES:
        return Check("shared memory", "ok", found, details=details)
    text = f"{found}: too little for several GPUs"
    return Check("shared memory", "warning", text, "in a container: docker run --shm-size=8g", details)


def graphics_check(answers: dict[str, Answer]) -> Check:
    """Return the check of OpenGL: which backends can render an image, and which one rlcli would use.

    Args:
        answers: name of a backend (egl, osmesa, ...) -> result of its separate process.
    """
    works = [name for name, (answer, _) in answers.items() if answer is not None]
    fails = {name: reason for name, (answer, reason) in answers.items() if answer is None}
    text = f"{', '.join(works) or 'nothing'} can render"
    text += "".join(f"; {name} cannot ({reason})" for name, reason in fails.items())
    details: dict[str, Any] = {"drawn": {name: name in works for name in answers}, "used": None}
    wanted = os.environ.get("MUJOCO_GL", "").strip().lower()
    if wanted in _OFF:
        return Check("graphics", "ok", f"MUJOCO_GL={wanted} switches OpenGL off; {text}", details=details)
    if wanted in answers and wanted not in works:
        return Check("graphics", "broken", f"MUJOCO_GL={wanted} cannot render; {text}", "unset MUJOCO_GL", details)
    if wanted and wanted not in (*answers, *_KNOWN):
        found = f"MuJoCo does not start with MUJOCO_GL={wanted}; {text}"
        return Check("graphics", "broken", found, "unset MUJOCO_GL", details)
    if not works:
        late = any(reason.startswith(_LATE) for reason in fails.values())
        hint = BUSY if late else f"for videos: {_PACKAGES} (Debian, Ubuntu)"
        return Check("graphics", "warning", text, hint, details)
    with contextlib.suppress(MachineError):
        details["used"] = next((name for name in candidates() if name in works), None)
    used = f"; {details['used']} is used" if details["used"] else ""
    return Check("graphics", "ok", f"{text}{used}", details=details)


_KNOWN = ("enable", "enabled", "on", "true", "1", "glx", "wgl", "cgl")
"""Further values that MuJoCo accepts in the environment variable MUJOCO_GL, besides the names of backends."""


def run_isolated(check_name: str, timeout_s: float) -> Answer:
    """Run a check of `isolated_checks.py` in a separate process.

    Args:
        check_name: compute, gpu, or an OpenGL backend such as egl.
        timeout_s: time limit [s].
    """
    command = python_command("-m", "rlcli.doctor.isolated_checks", check_name)
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
        return None, f"crashed ({signal_name(-done.returncode)})"
    return None, f"exit {done.returncode}" + (f": {lines[-1][:200]}" if lines else "")


def _major(version: str) -> int:
    """Return the first number of a version; 0 if there is none."""
    return next(iter(release_numbers(version)), 0)

"""Checks that may crash, run as `python -m rlcli.doctor.isolated_checks CHECK`; the result is printed as JSON."""

import contextlib
import ctypes
import json
import os
import sys
import threading
from typing import Any

from rlcli.doctor.installation import version
from rlcli.errors import MachineError, RlcliError, one_line
from rlcli.registry import malformed_metadata_ignored
from rlcli.sim.gl import has_display, open_context

_WORLD = """
<mujoco>
  <visual><headlight ambient="0.4 0.4 0.4"/></visual>
  <worldbody><body pos="0 0 1"><freejoint/><geom size="1" rgba="0.9 0.3 0.1 1"/></body></worldbody>
</mujoco>
"""
_PIXELS = 64


def _compute() -> dict[str, Any]:
    """Import torch and MuJoCo, compute with both, and return their versions."""
    before = _cores()
    import mujoco
    import torch

    model = mujoco.MjModel.from_xml_string(_WORLD)
    mujoco.mj_step(model, mujoco.MjData(model))
    torch.randn(512, 512) @ torch.randn(512, 512)
    torch.randn(1 << 16).sort()  # starts OpenMP, which may pin the process to fewer cores
    return {
        "torch": torch.__version__,
        "cuda": torch.version.cuda,
        "threads": torch.get_num_threads(),
        "mujoco": mujoco.mj_versionString(),
        "mujoco_package": version("mujoco"),
        "cores": [before, _cores()],
    }


def _cores() -> int:
    """Return the number of cores that a new thread may use. OpenMP may pin the main thread to fewer cores."""
    found: list[int] = []
    if not hasattr(os, "sched_getaffinity"):
        return os.cpu_count() or 1
    thread = threading.Thread(target=lambda: found.append(len(os.sched_getaffinity(0))))
    thread.start()
    thread.join()
    return found[0]


def _gpu() -> dict[str, Any]:
    """Return what the driver, torch and Warp report about the GPUs, as JSON data."""
    import torch

    devices, failure = [], ""
    try:
        devices = [torch.cuda.get_device_name(n) for n in range(torch.cuda.device_count())]
        if devices:
            float((torch.ones(8, device="cuda") * 2.0).sum())
    except Exception as error:  # the class depends on what does not fit: driver, build, device
        failure = f": {one_line(error, 200)}"
    return {
        "torch_cuda": torch.version.cuda,
        "torch_error": failure,
        "devices": devices,
        "driver_cuda": _driver(),
        "warp": _warp(),
    }


def _driver() -> str | None:
    """Return the newest CUDA version that the GPU's driver supports; None if there is no driver."""
    number = ctypes.c_int()  # 1000 * major + 10 * minor
    for name in ("libcuda.so.1", "nvcuda.dll"):
        with contextlib.suppress(OSError, AttributeError):
            if ctypes.CDLL(name).cuDriverGetVersion(ctypes.byref(number)) == 0:
                return f"{number.value // 1000}.{number.value % 1000 // 10}"
    return None


def _warp() -> dict[str, Any] | None:
    """Return `version`, `devices` and `error` of Warp, which the GPU engine uses; None if Warp is not installed."""
    if version("warp-lang") is None:
        return None
    found: dict[str, Any] = {"version": version("warp-lang"), "devices": [], "error": ""}
    try:
        import warp

        warp.config.quiet = True
        warp.init()
        found["devices"] = [str(device.name) for device in warp.get_cuda_devices()]
    except Exception as error:
        found["error"] = f"{type(error).__name__}: {one_line(error, 200)}"
    return found


def _render_image(backend: str) -> dict[str, Any]:
    """Check that an OpenGL backend can render an image without a window.

    The check uses only MuJoCo, because the import of rlcli's own renderer would take seconds.
    """
    if backend == "glfw" and not has_display():
        raise MachineError("there is no display; set DISPLAY, or use MUJOCO_GL=egl")
    os.environ["MUJOCO_GL"] = backend
    import mujoco
    import numpy as np

    model = mujoco.MjModel.from_xml_string(_WORLD)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    context, _ = open_context(_PIXELS, _PIXELS)
    scene, camera = mujoco.MjvScene(model, maxgeom=10), mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    everything = int(mujoco.mjtCatBit.mjCAT_ALL)
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, everything, scene)
    canvas = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, canvas)
    viewport = mujoco.MjrRect(0, 0, _PIXELS, _PIXELS)
    mujoco.mjr_render(viewport, scene, canvas)
    image = np.zeros((_PIXELS, _PIXELS, 3), np.uint8)
    mujoco.mjr_readPixels(image, None, viewport, canvas)
    canvas.free()
    context.free()
    if int(image.max()) - int(image.min()) < 16:
        raise MachineError(
            "rendering runs without an error, but the image is empty; try another MUJOCO_GL: egl, osmesa or glfw"
        )
    return {"backend": backend, "brightest": int(image.max())}


def _main(check_name: str) -> None:
    try:
        with malformed_metadata_ignored():
            checks = {"compute": _compute, "gpu": _gpu}
            answer = checks[check_name]() if check_name in checks else _render_image(check_name)
    except Exception as error:
        reason = error.message if isinstance(error, RlcliError) else f"{type(error).__name__}: {error}"
        answer = {"failed": " ".join(reason.split())[:300]}
    sys.stdout.write("\n" + json.dumps(answer) + "\n")
    sys.stdout.flush()
    os._exit(0)  # without unloading libraries: some graphics drivers crash then


if __name__ == "__main__":
    _main(sys.argv[1])

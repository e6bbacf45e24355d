"""`python -m rlcli.doctor QUESTION`: a process that answers with a line of JSON, and may crash of it."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import sys
import threading
from typing import Any

from rlcli.doctor.installation import version
from rlcli.errors import MachineError, RlcliError
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
    before = _cores()
    import mujoco
    import torch

    model = mujoco.MjModel.from_xml_string(_WORLD)
    mujoco.mj_step(model, mujoco.MjData(model))
    torch.randn(512, 512) @ torch.randn(512, 512)
    torch.randn(1 << 16).sort()  # OpenMP begins, and with it what it does to the cores of the process
    return {
        "torch": torch.__version__,
        "cuda": torch.version.cuda,
        "threads": torch.get_num_threads(),
        "mujoco": mujoco.mj_versionString(),
        "mujoco_package": version("mujoco"),
        "cores": [before, _cores()],
    }


def _cores() -> int:
    """Cores that a thread started now may use."""
    found: list[int] = []
    if not hasattr(os, "sched_getaffinity"):
        return os.cpu_count() or 1
    thread = threading.Thread(target=lambda: found.append(len(os.sched_getaffinity(0))))
    thread.start()
    thread.join()
    return found[0]


def _gpu() -> dict[str, Any]:
    import torch

    devices, failed = [], ""
    try:
        devices = [torch.cuda.get_device_name(n) for n in range(torch.cuda.device_count())]
        if devices:
            float((torch.ones(8, device="cuda") * 2.0).sum())
    except Exception as error:  # as many as there are ways not to fit
        failed = f": {' '.join(str(error).split())[:200]}"
    return {
        "torch_cuda": torch.version.cuda,
        "torch_error": failed,
        "devices": devices,
        "driver_cuda": _driver(),
        "warp": _warp(),
    }


def _driver() -> str | None:
    """The newest CUDA that the driver offers, as the driver's library says."""
    number = ctypes.c_int()
    for name in ("libcuda.so.1", "nvcuda.dll"):
        with contextlib.suppress(OSError, AttributeError):
            if ctypes.CDLL(name).cuDriverGetVersion(ctypes.byref(number)) == 0:
                return f"{number.value // 1000}.{number.value % 1000 // 10}"
    return None


def _warp() -> dict[str, Any] | None:
    if version("warp-lang") is None:
        return None
    found: dict[str, Any] = {"version": version("warp-lang"), "devices": [], "error": ""}
    try:
        import warp

        warp.config.quiet = True
        warp.init()
        found["devices"] = [str(device.name) for device in warp.get_cuda_devices()]
    except Exception as error:
        found["error"] = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
    return found


def _render_picture(backend: str) -> dict[str, Any]:
    """Draw a picture offscreen, as videos are drawn; without what is not drawing, which takes seconds to import."""
    if backend == "glfw" and not has_display():
        raise MachineError("there is no display")
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
    place = mujoco.MjrRect(0, 0, _PIXELS, _PIXELS)
    mujoco.mjr_render(place, scene, canvas)
    picture = np.zeros((_PIXELS, _PIXELS, 3), np.uint8)
    mujoco.mjr_readPixels(picture, None, place, canvas)
    canvas.free()
    context.free()
    if int(picture.max()) - int(picture.min()) < 16:
        raise MachineError("it draws, but the picture is empty")
    return {"backend": backend, "brightest": int(picture.max())}


def _main(check_name: str) -> None:
    try:
        with malformed_metadata_ignored():
            others = {"compute": _compute, "gpu": _gpu}
            answer = others[check_name]() if check_name in others else _render_picture(check_name)
    except Exception as error:
        said = error.message if isinstance(error, RlcliError) else f"{type(error).__name__}: {error}"
        answer = {"failed": " ".join(said.split())[:300]}
    sys.stdout.write("\n" + json.dumps(answer) + "\n")
    sys.stdout.flush()
    os._exit(0)  # some graphics drivers crash when they are unloaded


if __name__ == "__main__":
    _main(sys.argv[1])

"""Open an OpenGL context for rendering, with the first OpenGL library (backend) that works.

The environment variable MUJOCO_GL chooses the backend. If it is not set, these are tried: GLFW if there is a display,
then EGL, then OSMesa.
"""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from pathlib import Path
from typing import Any

from rlcli.errors import MachineError, one_line
from rlcli.machine.memory import require_address_space

_PACKAGES = {"egl": "libegl1", "osmesa": "libosmesa6", "glfw": "a running display server"}
_ADDRESS_SPACE = 2 << 30
"""Memory limit of a process (`ulimit -v`) [bytes] below which OpenGL fails with errors that do not mention memory."""


def opengl_import_error(error: BaseException) -> MachineError | None:
    """Return an error with a hint if `error`, from importing MuJoCo, is due to MUJOCO_GL; None for any other error.

    MuJoCo loads the OpenGL library that MUJOCO_GL names when MuJoCo is imported, even if nothing is rendered.
    """
    chosen = os.environ.get("MUJOCO_GL", "").strip()
    raised_in = [frame.filename for frame in traceback.extract_tb(error.__traceback__) if frame.name == "<module>"]
    if not chosen or not any(Path(file).parts[-2:] == ("classic", "gl_context.py") for file in raised_in):
        return None
    backend = chosen.lower()
    reason, advice = "MuJoCo has no such OpenGL backend", "use egl, osmesa, glfw or disable"
    if backend in _PACKAGES:
        reason, advice = f"its library cannot be loaded ({one_line(error, 100)})", f"install {_PACKAGES[backend]}"
    hint = f"{advice}, or unset MUJOCO_GL: rlcli then chooses a backend that works"
    return MachineError(f"MUJOCO_GL={chosen}: {reason}", hint=hint)


def has_display() -> bool:
    """Return whether windows can be opened: on Linux, whether DISPLAY or WAYLAND_DISPLAY is set; elsewhere True."""
    if sys.platform.startswith("linux"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True


def open_context(width: int, height: int, *, in_thread: bool = False) -> tuple[Any, str]:
    """Open an OpenGL context and make it current; return (context, name of its backend).

    Args:
        width: width of the images [pixels].
        height: height of the images [pixels].
        in_thread: whether the calling thread is not the main thread. GLFW, which must be opened in the main thread, is
            then tried last.

    Raises:
        MachineError: if no backend works; the message has the backends that were tried and the packages to install.
    """
    require_address_space(_ADDRESS_SPACE)
    tried = []
    backends = candidates()
    if in_thread:
        backends.sort(key=lambda backend: backend == "glfw")
    for backend in backends:
        try:
            context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
            context.make_current()
            if backend == "glfw" and not _has_window():
                raise MachineError("no window can be opened on the display")
        except Exception as error:  # each backend raises different errors: missing library, no device, no display
            tried.append(f"{backend} ({one_line(error, 100)})")
            _unload_opengl()
            continue
        return context, backend
    packages = " or ".join(_PACKAGES.get(backend, backend) for backend in candidates())
    message = f"no OpenGL backend works on this machine; tried {', '.join(tried)}"
    hint = f"install {packages} (Debian, Ubuntu: apt install libegl1 libosmesa6), or set MUJOCO_GL"
    raise MachineError(message, hint=hint)


def _has_window() -> bool:
    """Return whether GLFW opened a window; GLFW raises no error if it fails."""
    import glfw

    return bool(glfw.get_current_context())


def candidates() -> list[str]:
    """Return the names of the OpenGL backends to try, in this order.

    Raises:
        MachineError: if MUJOCO_GL disables rendering.
    """
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    if chosen in ("egl", "osmesa", "glfw", "cgl"):
        return [chosen]
    if chosen in ("disable", "disabled", "off", "false", "0"):
        raise MachineError(f"rendering is disabled by MUJOCO_GL={chosen}", hint="unset MUJOCO_GL")
    if sys.platform == "darwin":
        return ["cgl", "glfw"]
    if sys.platform == "win32":
        return ["glfw"]
    return ["glfw", "egl", "osmesa"] if has_display() else ["egl", "osmesa"]


def _unload_opengl() -> None:
    """Remove PyOpenGL from the imported modules, so that it can be imported for another backend."""
    os.environ.pop("PYOPENGL_PLATFORM", None)
    backends = ("mujoco.egl", "mujoco.osmesa", "mujoco.glfw")
    for name in [name for name in sys.modules if name.partition(".")[0] == "OpenGL" or name in backends]:
        del sys.modules[name]

"""Which OpenGL to draw with, chosen when something must be drawn and never before.

With MUJOCO_GL unset: a display's GL if there is a display, else EGL, else OSMesa.
"""

from __future__ import annotations

import importlib
import os
import sys
import traceback
from pathlib import Path
from typing import Any

from rlcli.errors import MachineError

_PACKAGES = {"egl": "libegl1", "osmesa": "libosmesa6", "glfw": "a running display server"}


def opengl_import_error(error: BaseException) -> MachineError | None:
    """What to say where MuJoCo could not be imported for what MUJOCO_GL says; None for any other error.

    MuJoCo loads the library of its choice at import, whether or not something is drawn.
    """
    chosen = os.environ.get("MUJOCO_GL", "").strip()
    raised_in = [frame.filename for frame in traceback.extract_tb(error.__traceback__) if frame.name == "<module>"]
    if not chosen or not any(Path(file).parts[-2:] == ("classic", "gl_context.py") for file in raised_in):
        return None
    backend = chosen.lower()
    if backend not in _PACKAGES:
        return MachineError(
            f"MUJOCO_GL={chosen}: MuJoCo knows no such OpenGL",
            hint="egl, osmesa, glfw or disable; unset MUJOCO_GL: rlcli then takes what works",
        )
    return MachineError(
        f"MUJOCO_GL={chosen}: its library cannot be loaded ({' '.join(str(error).split())[:100]})",
        hint=f"install {_PACKAGES[backend]}, or unset MUJOCO_GL: rlcli then takes what works",
    )


def has_display() -> bool:
    """Whether a window could be opened."""
    if sys.platform.startswith("linux"):
        return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    return True


def open_context(width: int, height: int, *, in_thread: bool = False) -> tuple[Any, str]:
    """A current OpenGL context and the name of what made it.

    Args:
        width: of its pictures.
        height: likewise.
        in_thread: it is opened, and used, in a thread that is not the main one: a display's GL, which has to be opened
            there, is then the last to be tried.

    Raises:
        MachineError: if nothing works, with what was tried and what to install.
    """
    tried = []
    backends = candidates()
    if in_thread:
        backends.sort(key=lambda backend: backend == "glfw")
    for backend in backends:
        try:
            context = importlib.import_module(f"mujoco.{backend}").GLContext(width, height)
            context.make_current()
            if backend == "glfw" and not _has_window():
                raise MachineError("the display does not answer")
        except Exception as error:  # every backend fails in its own way: missing library, device, display
            tried.append(f"{backend} ({' '.join(str(error).split())[:100] or type(error).__name__})")
            _unload_opengl()
            continue
        return context, backend
    packages = " or ".join(_PACKAGES.get(backend, backend) for backend in candidates())
    raise MachineError(
        f"nothing can draw on this machine; tried {', '.join(tried)}",
        hint=f"install {packages} (Debian, Ubuntu: apt install libegl1 libosmesa6), or set MUJOCO_GL",
    )


def _has_window() -> bool:
    """GLFW says with a warning alone that it has none."""
    import glfw

    return bool(glfw.get_current_context())


def candidates() -> list[str]:
    """The libraries to try, in this order.

    Raises:
        MachineError: if MUJOCO_GL says that nothing is to be drawn.
    """
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    if chosen in ("egl", "osmesa", "glfw", "cgl"):
        return [chosen]
    if chosen in ("disable", "disabled", "off", "false", "0"):
        raise MachineError(f"drawing is switched off by MUJOCO_GL={chosen}", hint="unset MUJOCO_GL")
    if sys.platform == "darwin":
        return ["cgl", "glfw"]
    if sys.platform == "win32":
        return ["glfw"]
    return ["glfw", "egl", "osmesa"] if has_display() else ["egl", "osmesa"]


def _unload_opengl() -> None:
    """PyOpenGL fixes its platform at import; the next backend needs it fresh."""
    os.environ.pop("PYOPENGL_PLATFORM", None)
    for name in [
        n for n in sys.modules if n.partition(".")[0] == "OpenGL" or n in ("mujoco.egl", "mujoco.osmesa", "mujoco.glfw")
    ]:
        del sys.modules[name]

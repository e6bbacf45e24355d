"""Offscreen pictures of an environment, and video files of them."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path
from types import TracebackType
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from rlcli.config.schema import ViewerConfig
from rlcli.errors import DependencyError, MachineError, UsageError
from rlcli.rl.files import disk_error
from rlcli.viewer.gl import open_context

FORMATS = (".mp4", ".gif")


def free_camera(viewer: ViewerConfig) -> mujoco.MjvCamera:
    """A camera at `eye` that looks at `lookat`."""
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(mujoco.MjModel.from_xml_string("<mujoco/>"), camera)
    ray = np.subtract(viewer.lookat, viewer.eye)
    camera.lookat[:] = viewer.lookat
    camera.distance = max(float(np.linalg.norm(ray)), 1e-3)
    camera.azimuth = math.degrees(math.atan2(ray[1], ray[0]))
    camera.elevation = math.degrees(math.asin(np.clip(ray[2] / camera.distance, -1.0, 1.0)))
    return camera


class Renderer:
    """Draws one environment offscreen.

    Args:
        model: its model.
        viewer: size and camera.

    Raises:
        MachineError: if nothing on this machine can draw.
    """

    def __init__(self, model: mujoco.MjModel, viewer: ViewerConfig) -> None:
        self._width, self._height = viewer.width, viewer.height
        self._context, self.backend = open_context(viewer.width, viewer.height)
        self._scene = mujoco.MjvScene(model, maxgeom=10_000)
        self._option = mujoco.MjvOption()
        self._camera = free_camera(viewer)
        self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._mjr)
        self._rect = mujoco.MjrRect(0, 0, viewer.width, viewer.height)

    def draw(self, model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.uint8]:
        """A picture of a forwarded state. (height, width, 3)"""
        everything = int(mujoco.mjtCatBit.mjCAT_ALL)
        mujoco.mjv_updateScene(model, data, self._option, None, self._camera, everything, self._scene)
        mujoco.mjr_render(self._rect, self._scene, self._mjr)
        pixels = np.empty((self._height, self._width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._rect, self._mjr)
        return pixels[::-1]

    def close(self) -> None:
        """Free the context."""
        self._mjr.free()
        self._context.free()


class VideoWriter:
    """Writes frames to an .mp4 or .gif; the file appears under its name only when it is whole.

    Args:
        file: where to.
        fps: frames a second.

    Raises:
        UsageError: for another kind of file.
        DependencyError: if imageio is not installed.
    """

    def __init__(self, file: Path, fps: float) -> None:
        check_video(file)
        import imageio.v2 as imageio

        self.file = file
        self.frames = 0
        self._temporary = file.with_name(f".{file.stem}.tmp{file.suffix}")
        settings: dict[str, Any] = {"duration": 1000.0 / fps, "loop": 0}
        if file.suffix == ".mp4":
            settings = {
                "fps": fps,
                "codec": "libx264",
                "quality": 7,
                "macro_block_size": 2,
                "ffmpeg_log_level": "error",
            }
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            self._writer: Any = imageio.get_writer(self._temporary, **settings)
        except OSError as error:
            raise disk_error(file, error) from error

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._writer.close()
            if kind is None and self.frames:
                self._temporary.replace(self.file)
        except OSError as failure:
            raise disk_error(self.file, failure) from failure
        finally:
            self._temporary.unlink(missing_ok=True)

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Append a frame. (height, width, 3)"""
        try:
            self._writer.append_data(np.ascontiguousarray(picture))
        except OSError as error:
            raise MachineError(f"cannot write {self.file}: {error}") from error
        self.frames += 1


def check_video(file: Path) -> None:
    """Refuse what cannot be written, before anything is simulated.

    Raises:
        UsageError: for a file that is neither .mp4 nor .gif.
        DependencyError: if imageio is not installed.
    """
    if file.suffix not in FORMATS:
        raise UsageError(f"'{file}' is not a video file", hint=f"name it *{' or *'.join(FORMATS)}")
    needed = ["imageio"] if file.suffix == ".gif" else ["imageio", "imageio_ffmpeg"]
    if any(importlib.util.find_spec(name) is None for name in needed):
        raise DependencyError("imageio is not installed", hint='pip install "rlcli[video]"')

"""Writer of video files (.mp4, .gif), and a check that this machine can write a video.

Importing the module is fast, so that commands can refuse a wrong file name at once.
"""

from __future__ import annotations

import contextlib
import importlib.util
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.errors import DependencyError, MachineError, UsageError, pip_install
from rlcli.runs.atomic_io import disk_error, disk_errors, require_regular

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

FORMATS = (".mp4", ".gif")


def check_video(file: Path) -> None:
    """Check that a video can be written to a file, before anything is simulated.

    Raises:
        UsageError: for a file that is neither .mp4 nor .gif.
        DependencyError: if imageio, or imageio-ffmpeg for an .mp4, is not installed.
        MachineError: if there is no ffmpeg for an .mp4.
    """
    if file.suffix not in FORMATS:
        raise UsageError(f"'{file}' is not a video file", hint=f"give FILE{' or FILE'.join(FORMATS)}")
    needed = ["imageio"] if file.suffix == ".gif" else ["imageio", "imageio_ffmpeg"]
    if any(importlib.util.find_spec(name) is None for name in needed):
        message = f"a video in {file.suffix} needs {' and '.join(needed)}"
        raise DependencyError(message, hint=pip_install("rlcli[video]"))
    if file.suffix == ".mp4":
        _require_ffmpeg()


def _require_ffmpeg() -> None:
    """Check that the program ffmpeg is available; on most platforms, imageio-ffmpeg contains the program.

    Raises:
        MachineError: if there is no ffmpeg.
    """
    import imageio_ffmpeg

    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError:
        problem = "an .mp4 needs the program ffmpeg, which was not found"
    else:
        if shutil.which(program):
            return
        problem = f"IMAGEIO_FFMPEG_EXE is not a program: {program}"
    raise MachineError(problem, hint="install ffmpeg (Debian, Ubuntu: apt install ffmpeg), or write a .gif")


class VideoWriter(contextlib.AbstractContextManager["VideoWriter"]):
    """Writer of images to an .mp4 or .gif, used in a `with` block; the file gets its name only at the end of the block.

    If the block raises an error or adds no image, no file is written. A frame of a GIF lasts a whole number of
    hundredths of a second, and players show frames shorter than 0.02 s too slowly. So a GIF of shorter frames has only
    every n-th image: the smallest n whose speed is right within 2 %.

    Args:
        file: path of the video.
        period: time between two images [s].

    Raises:
        UsageError: for a file with another suffix.
        DependencyError: if imageio is not installed.
        MachineError: if there is no ffmpeg for an .mp4, or the file cannot be written.
    """

    def __init__(self, file: Path, period: float) -> None:
        check_video(file)
        require_regular(file)
        import imageio.v2 as imageio

        self.file = file
        self.frames = 0
        self._added = 0
        self._stride = gif_stride(period) if file.suffix == ".gif" else 1
        self.fps = 1.0 / (period * self._stride)
        self._temporary = file.with_name(f".{file.stem}.tmp{file.suffix}")
        # a GIF has the duration of a frame [ms]
        settings: dict[str, Any] = {"duration": 10.0 * round(100.0 / self.fps), "loop": 0}
        if file.suffix == ".mp4":
            # H.264 needs an even width and height: macro blocks of 2 pixels keep the size closest
            settings = {"fps": self.fps, "codec": "libx264", "quality": 7, "macro_block_size": 2}
            settings["ffmpeg_log_level"] = "error"
        with disk_errors(file):
            file.parent.mkdir(exist_ok=True)
            self._temporary.unlink(missing_ok=True)  # the writer would follow a symbolic link
            self._writer: Any = imageio.get_writer(self._temporary, **settings)

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            with disk_errors(self.file):
                self._writer.close()
                if kind is None and self.frames:
                    self._temporary.replace(self.file)
        finally:
            self._temporary.unlink(missing_ok=True)

    def add(self, image: NDArray[np.uint8]) -> None:
        """Append an RGB image to the video. (height, width, 3)

        Raises:
            MachineError: if the file cannot be written.
        """
        self._added += 1
        if (self._added - 1) % self._stride:
            return
        try:
            self._writer.append_data(image)
        except OSError as error:
            raise disk_error(self.file, error) from error
        self.frames += 1


def gif_stride(period: float) -> int:
    """Return the smallest n such that a GIF of every n-th image plays at the right speed within 2 %.

    The result is 1 if there is no such number below 64; see `VideoWriter` for the reason.

    Args:
        period: time between two images [s].
    """
    strides = range(1, 64)
    return next(
        (k for k in strides if (n := round(100 * period * k)) >= 2 and abs(n / (100 * period * k) - 1) < 0.02), 1
    )

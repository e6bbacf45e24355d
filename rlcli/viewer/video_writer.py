"""Writer of video files (.mp4, .gif), and a check that this machine can write a video.

Importing the module is fast, so that commands can refuse a wrong file name at once.
"""

from __future__ import annotations

import contextlib
import errno
import importlib.util
import os
import shutil
import signal
import subprocess
import tempfile
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rlcli.errors import DependencyError, MachineError, UsageError, pip_install
from rlcli.runs.atomic_io import disk_errors, remove_leftovers, require_regular
from rlcli.safe_text import shorten

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

FORMATS = (".mp4", ".gif")


def check_video(file: Path) -> None:
    """Check that a video can be written to a file, before anything is simulated.

    Raises:
        UsageError: for a file that is neither .mp4 nor .gif.
        DependencyError: if imageio for a .gif, or imageio-ffmpeg for an .mp4, is not installed.
        MachineError: if there is no ffmpeg for an .mp4.
    """
    if file.suffix not in FORMATS:
        raise UsageError(f"'{file}' is not a video file", hint=f"give FILE{' or FILE'.join(FORMATS)}")
    needed = "imageio" if file.suffix == ".gif" else "imageio_ffmpeg"
    if importlib.util.find_spec(needed) is None:
        raise DependencyError(f"a video in {file.suffix} needs {needed}", hint=pip_install("rlcli[video]"))
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
        DependencyError: if imageio or imageio-ffmpeg is not installed.
        MachineError: if there is no ffmpeg for an .mp4, or the file cannot be written.
    """

    def __init__(self, file: Path, period: float) -> None:
        check_video(file)
        require_regular(file)
        self.file = file
        self.frames = 0
        self._added = 0
        self._stride = gif_stride(period) if file.suffix == ".gif" else 1
        self.fps = 1.0 / (period * self._stride)
        self._temporary = file.with_name(f".{file.name}.tmp-{os.getpid()}{file.suffix}")
        with disk_errors(file):
            file.parent.mkdir(exist_ok=True)
            remove_leftovers(file.parent, file.name)
            self._temporary.unlink(missing_ok=True)  # the writer would follow a symbolic link
            self._temporary.open("xb").close()  # a file that cannot be written is an error here, not at the end
            self._writer = _gif(self._temporary, self.fps) if file.suffix == ".gif" else _Mp4(self._temporary, self.fps)

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
        with disk_errors(self.file):
            self._writer.append_data(image)
        self.frames += 1


def _gif(file: Path, fps: float) -> Any:
    """Return imageio's writer of a GIF that repeats."""
    import imageio.v2 as imageio

    return imageio.get_writer(file, duration=10.0 * round(100.0 / fps), loop=0)  # duration of a frame [ms]


class _Mp4:
    """Writer of an .mp4: a process of ffmpeg reads the images from a pipe.

    imageio's own writer ignores the exit code of ffmpeg, and a video that is cut off by a full disk counts as written.

    Args:
        file: path of the video.
        fps: images per second.
    """

    def __init__(self, file: Path, fps: float) -> None:
        self._file = file
        self._fps = Fraction(fps).limit_denominator()
        self._process: subprocess.Popen[bytes] | None = None

    def append_data(self, image: NDArray[np.uint8]) -> None:
        """Append an RGB image. (height, width, 3)

        Raises:
            OSError: if ffmpeg has ended; the error has its last message.
        """
        process = self._process or self._start(*image.shape[:2])
        assert process.stdin is not None
        try:
            process.stdin.write(image.tobytes())
        except BrokenPipeError:
            self.close()
            raise

    def _start(self, height: int, width: int) -> subprocess.Popen[bytes]:
        import imageio_ffmpeg

        images = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(self._fps), "-i", "-"]
        # the pixel format that most players need, with an even width and height
        video = ["-vcodec", "libx264", "-crf", "15", "-pix_fmt", "yuv420p"]
        if width % 2 or height % 2:
            video += ["-vf", f"scale={width + width % 2}:{height + height % 2}"]
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-v", "error", *images, *video, str(self._file.absolute())]
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `close`; a full pipe would block ffmpeg
        # in a process group of its own: Ctrl-C does not end ffmpeg
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=self._errors, process_group=0
        )
        return self._process

    def close(self) -> None:
        """Wait until ffmpeg has written the file.

        Raises:
            OSError: if ffmpeg has failed.
        """
        process, self._process = self._process, None
        if process is None:
            return
        with self._errors:
            with contextlib.suppress(BrokenPipeError):
                process.communicate()
            code = process.wait()
            self._errors.seek(0)
            messages = self._errors.read().decode(errors="replace")
        if code:
            raise _ffmpeg_error(code, messages)


def _ffmpeg_error(code: int, messages: str) -> OSError:
    """Return the system's error for which ffmpeg has failed, or one with the last line that ffmpeg printed."""
    if code == -getattr(signal, "SIGXFSZ", 0):
        return OSError(errno.EFBIG, os.strerror(errno.EFBIG))
    for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.EACCES):
        if os.strerror(number) in messages:
            return OSError(number, os.strerror(number))
    last = " ".join((messages.splitlines() or [""])[-1].split())
    return OSError(f"ffmpeg failed with exit code {code}: {shorten(last, 200)}" if last else f"ffmpeg failed: {code}")


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

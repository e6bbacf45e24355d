"""Video files; light, so that a wrong name is refused before anything is built."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from rlcli.errors import DependencyError, MachineError, UsageError
from rlcli.runs.atomic_io import disk_error

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

FORMATS = (".mp4", ".gif")


def check_video(file: Path) -> None:
    """Refuse what cannot be written, before anything is simulated.

    Raises:
        UsageError: for a file that is neither .mp4 nor .gif, or whose folder is a file.
        DependencyError: if imageio is not installed.
        MachineError: if there is no ffmpeg for an .mp4.
    """
    if file.suffix not in FORMATS:
        raise UsageError(f"'{file}' is not a video file", hint=f"name it *{' or *'.join(FORMATS)}")
    needed = ["imageio"] if file.suffix == ".gif" else ["imageio", "imageio_ffmpeg"]
    if any(importlib.util.find_spec(name) is None for name in needed):
        raise DependencyError("imageio is not installed", hint='pip install "rlcli[video]"')
    if file.suffix == ".mp4":
        _require_ffmpeg()


def _require_ffmpeg() -> None:
    """imageio-ffmpeg brings one, where the platform has a wheel with it."""
    import imageio_ffmpeg

    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError:
        said = "there is no ffmpeg, which writes .mp4"
    else:
        if shutil.which(program):
            return
        said = f"IMAGEIO_FFMPEG_EXE names no program: {program}"
    hint = "install it (Debian, Ubuntu: apt install ffmpeg); a .gif needs none"
    raise MachineError(said, hint=hint)


class VideoWriter:
    """Writes frames to an .mp4 or .gif; the file appears under its name only when it is whole.

    A GIF's frames last whole hundredths of a second, and players slow down those under two: of faster episodes it
    holds every second, third, ... frame, the first choice whose speed is right within 2 %.

    Args:
        file: where to.
        period: time between two pictures [s].

    Raises:
        UsageError: for another kind of file.
        DependencyError: if imageio is not installed.
    """

    def __init__(self, file: Path, period: float) -> None:
        check_video(file)
        import imageio.v2 as imageio

        self.file = file
        self.frames = 0
        self._added = 0
        self._every = gif_stride(period) if file.suffix == ".gif" else 1
        self.fps = 1.0 / (period * self._every)
        self._temporary = file.with_name(f".{file.stem}.tmp{file.suffix}")
        settings: dict[str, Any] = {"duration": 10.0 * round(100.0 / self.fps), "loop": 0}
        if file.suffix == ".mp4":
            settings = {
                "fps": self.fps,
                "codec": "libx264",
                "quality": 7,
                "macro_block_size": 2,
                "ffmpeg_log_level": "error",
            }
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            self._temporary.unlink(missing_ok=True)  # a link in its place would be followed
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
        """Append a picture. (height, width, 3)"""
        self._added += 1
        if (self._added - 1) % self._every:
            return
        try:
            self._writer.append_data(picture)
        except OSError as error:
            raise MachineError(f"cannot write {self.file}: {error}") from error
        self.frames += 1


def gif_stride(period: float) -> int:
    """Every how many pictures a GIF takes, for a period [s] between pictures."""
    strides = range(1, 64)
    return next(
        (k for k in strides if (n := round(100 * period * k)) >= 2 and abs(n / (100 * period * k) - 1) < 0.02), 1
    )

"""Folders of Isaac Lab's models. They do not exist here: `model_lookup.py` finds an MJCF by the end of such a path."""

from __future__ import annotations

import io
from pathlib import Path

from rlcli.errors import TaskError
from rlcli_isaaclab.missing_names import user_place

NUCLEUS_ASSET_ROOT_DIR = "nucleus"
NVIDIA_NUCLEUS_DIR = f"{NUCLEUS_ASSET_ROOT_DIR}/NVIDIA"
ISAAC_NUCLEUS_DIR = f"{NUCLEUS_ASSET_ROOT_DIR}/Isaac"
ISAACLAB_NUCLEUS_DIR = f"{ISAAC_NUCLEUS_DIR}/IsaacLab"


def retrieve_file_path(path: str, download_dir: str | None = None, force_download: bool = True) -> str:
    """Return `path`, or with `download_dir` the path of the file with the same name in this folder.

    Nothing is downloaded.

    Raises:
        TaskError: if the folder does not have the file.
    """
    if download_dir is None or Path(path).is_file():
        return path
    file = Path(download_dir).resolve() / Path(path).name
    if not file.is_file():
        what = f"{user_place()}'{path}' is a file of NVIDIA's server, and rlcli downloads nothing"
        raise TaskError(what, hint=f"download the file yourself, and save it as {file}")
    return str(file)


def check_file_path(path: str) -> int:
    """Return 1 for a local file, else 2, which in Isaac Lab means that the file is on a server.

    2 does not show that the file exists: rlcli checks models when it reads the scene.
    """
    return 1 if Path(path).is_file() else 2


def read_file(path: str) -> io.BytesIO:
    """Return the content of a local file.

    Raises:
        TaskError: if there is no such file.
    """
    if Path(path).is_file():
        return io.BytesIO(Path(path).read_bytes())
    is_remote = path.startswith(NUCLEUS_ASSET_ROOT_DIR) or "://" in path
    reason = "is on a server, and rlcli downloads nothing" if is_remote else "does not exist"
    hint = "download the file yourself, and write its path" if is_remote else "create the file, or write another path"
    raise TaskError(f"{user_place()}the file '{path}' {reason}", hint=hint)

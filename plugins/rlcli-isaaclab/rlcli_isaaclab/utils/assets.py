"""Folders of Isaac Lab's models. Only the ends of such paths matter: `model_lookup.py` maps them."""

NUCLEUS_ASSET_ROOT_DIR = "nucleus"
NVIDIA_NUCLEUS_DIR = f"{NUCLEUS_ASSET_ROOT_DIR}/NVIDIA"
ISAAC_NUCLEUS_DIR = f"{NUCLEUS_ASSET_ROOT_DIR}/Isaac"
ISAACLAB_NUCLEUS_DIR = f"{ISAAC_NUCLEUS_DIR}/IsaacLab"


def retrieve_file_path(path: str, download_dir: str | None = None, force_download: bool = True) -> str:
    """Return the path: nothing is downloaded."""
    return path


def check_file_path(path: str) -> int:
    """Return 2, as for a file on a server: whether the file exists is checked where a model replaces it."""
    return 2

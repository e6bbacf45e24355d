"""Folders of Isaac Lab's models. Only the ends of such paths matter: `assets.USD_TO_MJCF` maps them."""

NUCLEUS_ASSET_ROOT_DIR = "nucleus"
NVIDIA_NUCLEUS_DIR = f"{NUCLEUS_ASSET_ROOT_DIR}/NVIDIA"
ISAAC_NUCLEUS_DIR = f"{NUCLEUS_ASSET_ROOT_DIR}/Isaac"
ISAACLAB_NUCLEUS_DIR = f"{ISAAC_NUCLEUS_DIR}/IsaacLab"

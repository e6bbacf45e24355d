"""Entry point of the plugin (`rlcli.formats`): how rlcli recognises and reads tasks of Isaac Lab."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import TYPE_CHECKING

from rlcli.formats import FormatSpec

if TYPE_CHECKING:
    from rlcli.registry import TaskSource

_RUNNER = b"RslRlOnPolicyRunnerCfg"

LIBRARIES = {
    **{name: name for name in ("torchvision", "prettytable", "einops", "transformers", "numba", "warp", "psutil")},
    **{name: name for name in ("scipy", "matplotlib", "pandas", "h5py", "tqdm", "imageio", "networkx", "shapely")},
    **{"hydra": "hydra-core", "omegaconf": "omegaconf", "wandb": "wandb", "tensorboard": "tensorboard"},
    **{"hid": "hidapi", "sklearn": "scikit-learn", "cv2": "opencv-python", "PIL": "pillow", "warp": "warp-lang"},
}
"""Library that Isaac Lab installs -> its name for pip. If a library is missing, an error is raised when it is used."""
_FRAMEWORK = (
    *("isaaclab", "isaaclab_tasks", "isaaclab_assets", "isaaclab_rl", "isaaclab_contrib", "isaaclab_mimic"),
    *("isaacsim", "omni", "pxr", "carb", "usdrt"),
)
TRAINERS = ("rsl_rl",)
"""Libraries of agents, of which task repositories often need a certain version. If the library or a name in it is
missing, an error is raised only when the name is used."""
_LIBRARIES = ("toml", "pink", "pinocchio", "trimesh", *TRAINERS, *LIBRARIES)
FOREIGN = (*_FRAMEWORK, *_LIBRARIES)
"""Packages whose modules `namespace.py` replaces in task files."""

SPEC = FormatSpec(
    summary="tasks of Isaac Lab",
    find="rlcli_isaaclab.format:find",
    importer="rlcli_isaaclab.command:import_run",
    hint="rlcli_isaaclab.import_hints:import_hint",
    agent_file="rlcli_isaaclab.agent_files:read_agent",
    agent_order=("rsl-rl", "rl-games", "skrl", "sb3"),
    agents_beside="rlcli_isaaclab.format:agents_beside",
    aliases={"rlcli.isaaclab": "rlcli_isaaclab", **dict.fromkeys(FOREIGN, "rlcli_isaaclab.namespace:module_of")},
    libraries=_LIBRARIES,
)


def find(path: Path) -> TaskSource | None:
    """Return the task of a folder whose Python files have one environment class; None if they have none.

    Raises:
        TaskError: if there are several environment classes.
    """
    from rlcli.errors import TaskError, listing
    from rlcli.registry import python_config, python_task

    if not path.is_dir() or python_config(path) is not None:
        return None
    classes = _environments(path)
    if len(classes) > 1:
        names = listing(f"{path.name}/{found}" for found in classes)
        raise TaskError(f"'{path}' contains several tasks", hint=f"choose one: {names}")
    return python_task(f"{path / classes[0]}", path.name) if classes else None


def agents_beside(folder: Path) -> list[Path]:
    """Return the Python files of a folder that contain a runner configuration of RSL-RL, the settings of an agent."""
    return sorted(file for file in folder.glob("*.py") if _RUNNER in file.read_bytes())


def _environments(root: Path) -> list[str]:
    """Return `file.py:Class` of every environment in a folder, without the base classes that its files subclass."""
    classes = [
        (file.name, node.name, {ast.unparse(base).rpartition(".")[2] for base in node.bases})
        for file in sorted(root.glob("*.py"))
        for node in _body(file)
        if isinstance(node, ast.ClassDef)
    ]
    # Subclasses may come before their base class: repeat until no class is added.
    kinds, before = {"ManagerBasedRLEnvCfg"}, 0
    while len(kinds) > before:
        before = len(kinds)
        kinds |= {name for _, name, bases in classes if bases & kinds}
    inner = {(file, base) for file, _, bases in classes for base in bases}
    return [
        f"{file}:{name}"
        for file, name, bases in classes
        if bases & kinds and (file, name) not in inner and not name.upper().endswith("_PLAY")
    ]


def _body(file: Path) -> list[ast.stmt]:
    try:
        return ast.parse(file.read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return []

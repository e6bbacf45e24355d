"""Replacements of modules that task files import: `omni.*`, `pxr`, `carb`, `gym`, `hydra`, `omniisaacgymenvs.*`.

If `rlcli_oige` has a name, the task gets that object, whatever module the task imports it from. Calls of functions
without an effect in MuJoCo are recorded. All other names can be imported; their use raises an error.
"""

from __future__ import annotations

import ast
import importlib.util
import re
from pathlib import Path
from types import ModuleType
from typing import Any

from rlcli.errors import TaskError
from rlcli_oige import name_lookup
from rlcli_oige.task_class import parse_file
from rlcli_oige.usd_names import Ignored, UsdContext, missing

_REMOVED = re.compile(r"\b(?:np|numpy)\.(?:Inf|Infinity|NaN|float_)\b")
_modules: dict[str, ModuleType] = {}

_IGNORED = {
    "enable_extension": "rlcli loads no extensions of Isaac Sim",
    "PreviewSurface": "materials are part of the MJCF model",
    "VisualMaterial": "materials are part of the MJCF model",
    "OmniPBR": "materials are part of the MJCF model",
    "OmniGlass": "materials are part of the MJCF model",
    "DifferentialController": "rlcli has no wheel controller; the task must set the speeds of the wheels",
}
"""Name of a class or function -> why its calls have no effect."""
_REASONS = {
    "omni.isaac.core.prims.soft": "PhysX simulates deformable bodies on its GPU; rlcli simulates rigid bodies",
    "omni.isaac.core.materials.deformable_material": "PhysX simulates deformable bodies on its GPU",
    "omni.isaac.core.utils.deformable_mesh_utils": "PhysX simulates deformable bodies on its GPU",
    "omni.physx": "it edits the meshes of a USD file; give an MJCF with --model",
    "omni.replicator": "rlcli has no replicator; cameras are sensors of the scene",
    "omni.isaac.sensor": "cameras are sensors of the scene",
    "omni.isaac.core.utils.warp": "tasks with Warp arrays are not supported; use the task's torch version",
    "hydra": "rlcli composes the YAML files before the task starts, and has no Hydra at run time (Factory's tasks also"
    " read Jacobians and mass matrices, which rlcli's views do not have)",
    "omegaconf": "it is not installed (pip install omegaconf)",
    "warp": "tasks with Warp arrays are not supported; use the task's torch version",
}
"""Module -> why names below it have no counterpart."""
_REFUSED = {
    "omniisaacgymenvs.tasks.franka_deformable": "PhysX simulates deformable bodies on its GPU; rlcli simulates rigid"
    " bodies",
    "omniisaacgymenvs.tasks.warp": "tasks with Warp arrays are not supported; use the task's torch version",
}
"""Module of the task's package -> why a task that imports the module cannot run."""


def find(name: str, file: str = "") -> ModuleType:
    """Return the replacement of a module that a task's file imports.

    Raises:
        TaskError: for a module that no task of rlcli can use.
    """
    if name not in _modules:
        module = _modules[name] = (_TaskModule if name.split(".")[0] == "omniisaacgymenvs" else _Module)(name)
        parent, _, last = name.rpartition(".")
        if parent:
            setattr(find(parent), last, module)
    return _modules[name]


def find_numpy(name: str, file: str = "") -> ModuleType | None:
    """Return numpy with the names that NumPy 2 has removed, for a file that uses one of them; None for other files."""
    if name != "numpy" or not file or not _REMOVED.search(Path(file).read_text(encoding="utf-8", errors="replace")):
        return None
    if name not in _modules:
        numpy = importlib.import_module(name)
        module = _modules[name] = ModuleType(name)
        vars(module).update(
            {**vars(numpy), "Inf": numpy.inf, "Infinity": numpy.inf, "NaN": numpy.nan, "float_": numpy.float64}
        )
    return _modules[name]


def find_hydra(name: str, file: str = "") -> ModuleType | None:
    """Return the replacement of `hydra` for a file of OmniIsaacGymEnvs: the use of its names raises an error.

    Return a replacement of `omegaconf` too, if it is not installed. Return None in all other cases.
    """
    own = file and "omniisaacgymenvs" in Path(file).read_text(encoding="utf-8", errors="replace")
    return find(name) if own and (name != "omegaconf" or importlib.util.find_spec(name) is None) else None


def refuse(name: str, file: Path) -> None:
    """Raise an error for a module of the user's package whose tasks rlcli cannot run; other modules pass.

    Raises:
        TaskError: with the reason, and the line of the first import that has no counterpart.
    """
    reason = next((text for module, text in _REFUSED.items() if f"{name}.".startswith(f"{module}.")), None)
    if reason is not None:
        raise TaskError(f"{file}:{_line_without_counterpart(file)}: {name}: {reason}")


def _line_without_counterpart(file: Path) -> int:
    """Return the line of the first import of a module of `_REASONS`; 1 if a file has none."""
    for node in ast.walk(parse_file(file)):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
        if any(f"{name}.".startswith(f"{module}.") for name in names for module in _REASONS):
            return node.lineno  # type: ignore[attr-defined]
    return 1


class _Module(ModuleType):
    """Replacement for a module of Omniverse or USD."""

    def __getattr__(self, name: str) -> Any:
        vocabulary = importlib.import_module("rlcli_oige.vocabulary")
        if name == "__all__":
            return list(vocabulary.MATHS)
        if name.startswith("__"):
            raise AttributeError(name)
        if name == "torch_utils" or name not in vocabulary.NAMES:
            return self._without_counterpart(name)
        return getattr(vocabulary, name)

    def _without_counterpart(self, name: str) -> Any:
        full = f"{self.__name__}.{name}"
        if full == "omni.usd.get_context":
            return UsdContext
        if full in ("warp.to_torch", "warp.int32"):  # arrays of annotators are tensors
            return getattr(importlib.import_module("rlcli_oige.cameras"), f"warp_{name}")
        if name in _IGNORED:
            return Ignored(name, _IGNORED[name])
        reason = next((text for module, text in _REASONS.items() if f"{full}.".startswith(f"{module}.")), None)
        return missing(self.__name__, name, *(() if reason is None else (reason,)))


class _TaskModule(_Module):
    """Module `omniisaacgymenvs.*` for files outside of that package. Its names come from the task's files."""

    def _without_counterpart(self, name: str) -> Any:
        return name_lookup.find(name, importlib.import_module("rlcli_oige.vocabulary").NAMES)

"""Replacement for the modules `isaaclab` and `isaacsim` that task files import.

The file `names.json` lists the public names of each module of Isaac Lab; `tools/names.py` writes it. If this package
defines a name, the task gets that object. For any other name in the list the task gets a replacement, which raises an
error when the task uses it.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from rlcli.errors import did_you_mean
from rlcli.registry.framework_imports import import_package, is_task_package
from rlcli.registry.task_imports import import_from
from rlcli_isaaclab.config_class import configclass
from rlcli_isaaclab.format import LIBRARIES, TRAINERS
from rlcli_isaaclab.missing_names import (
    AbsentValue,
    absent_class,
    absent_function,
    absent_module,
    absent_value,
    user_place,
)

_OWN = "rlcli_isaaclab"
_EXTRA = {
    "isaaclab_rl": ("rsl_rl",),
    "isaaclab_assets": ("assets",),
    "isaaclab_tasks": ("mdp", "task_utils"),
    "isaaclab_contrib": ("multirotor", "action_terms"),
    "isaaclab.envs.mdp": ("mdp", "action_terms", "command_terms"),
    "isaaclab.sim": ("usd_stage", "usd_geometry", "setup_scene"),
    "isaaclab.utils.math": ("utils.poses",),
    "isaaclab.actuators": ("actuator_classes",),
    "isaaclab.sensors": ("sensors.patterns",),
}
"""Module of Isaac Lab -> modules of this package that define further names of it."""
_STAR_NAMES = {
    "isaaclab.envs.mdp": (
        *("ActionTerm", "ActionTermCfg", "CommandTerm", "CommandTermCfg", "CurriculumTermCfg", "EventTermCfg"),
        *(
            "ManagerTermBase",
            "ObservationTermCfg",
            "RewardTermCfg",
            "RecorderTerm",
            "RecorderTermCfg",
            "SceneEntityCfg",
        ),
        *(
            "Articulation",
            "DeformableObject",
            "RigidObject",
            "TerrainImporter",
            "ImplicitActuator",
            "VisualizationMarkers",
        ),
        *("Camera", "ContactSensor", "FrameTransformer", "Imu", "RayCaster", "RayCasterCamera", "TiledCamera"),
        *("ContactSensorCfg", "FrameTransformerCfg", "DifferentialIKControllerCfg", "OperationalSpaceControllerCfg"),
        *("MISSING", "configclass", "sim_utils", "math_utils", "string_utils", "math", "re", "torch", "Literal"),
        *("combine_frame_transforms", "compute_pose_error", "euler_xyz_from_quat", "quat_apply_inverse"),
        *("quat_from_euler_xyz", "quat_unique", "wrap_to_pi", "yaw_quat", "generic_io_descriptor", "Sequence"),
    )
}
"""Module -> names that the files of the module import themselves, so that `from MODULE import *` has them, too."""
_LIBRARY_NAMES = {
    **{"math_utils": "isaaclab.utils.math", "string_utils": "isaaclab.utils.string", "sim_utils": "isaaclab.sim"},
    **{"math": "math", "re": "re", "torch": "torch", "Literal": "typing", "Sequence": "collections.abc"},
}
"""Name in `_STAR_NAMES` -> the module with this name, or the module that defines the name."""
SOURCE_PACKAGES = ("isaaclab_tasks", "isaaclab_assets")
"""Packages whose original files are imported if they are found, because their code only uses other modules."""
_TORCH = "isaacsim.core.utils.torch"
_SIM = {
    **dict.fromkeys((_TORCH, *(f"{_TORCH}.{n}" for n in ("rotations", "maths", "transformations"))), "isaacsim_torch"),
    "isaacsim.core.version": "utils.version",
}
"""Module of Isaac Sim -> module of this package with its functions."""


class LabModule(ModuleType):
    """Replacement for a module of Isaac Lab; each of its names is looked up at its first use."""

    def __getattr__(self, name: str) -> Any:
        if name == "__all__":
            return public_names(self.__name__)
        if name.startswith("__"):
            raise AttributeError(name)
        value = _member(self.__name__, name)
        if self.__name__.startswith("isaaclab_assets") and isinstance(value, AbsentValue):
            return AbsentValue(value.absent_name, user_place())  # not stored: each file has its own place
        setattr(self, name, value)
        return value


SOURCE = "RLCLI_ISAACLAB"
"""Environment variable with Isaac Lab's folder `source`, for the files of `isaaclab_tasks` and `isaaclab_assets`."""


def module_of(name: str, file: str) -> ModuleType | None:
    """Return the module that replaces a module of Isaac Lab or Isaac Sim; None to import an installed one.

    The files of `isaaclab_tasks` and `isaaclab_assets` are searched for in the folders above `file`, which has the
    import statement, in the folder RLCLI_ISAACLAB and in an installed wheel of Isaac Lab.
    """
    top, _, inner = name.partition(".")
    # `isaaclab_tasks.utils` is replaced by this package's `task_utils`
    if top in SOURCE_PACKAGES and not inner.startswith("utils"):
        folder = _source_folder(top, Path(file).parent, inner.partition(".")[0])
        if folder is not None:
            return _of_source(name, folder, inner)
    if top in TRAINERS:
        return _trainer_module(name, file)
    if top in ("toml", "trimesh", *LIBRARIES) and importlib.util.find_spec(top) is not None:
        return None
    if top in ("toml", "trimesh"):
        return importlib.import_module(f"{_OWN}.{top}_reader" if top == "toml" else f"{_OWN}.triangle_mesh")
    if name == "isaacsim.core.utils.stage":
        return importlib.import_module(f"{_OWN}.usd_stage")
    if name in _SIM:
        return importlib.import_module(f"{_OWN}.{_SIM[name]}")
    if not top.startswith("isaaclab"):
        return absent_module(name)
    if name not in _modules():
        moved = [m for m in _modules() if m.startswith(f"{top}.") and m.endswith("." + name.rpartition(".")[2])]
        if len(moved) == 1:  # earlier versions of Isaac Lab 2 have some modules in other packages
            return _lab_module(moved[0])
        near = did_you_mean(name, sorted(_modules()))
        what = f"Isaac Lab 2.3.2 has no module '{name}'"
        raise ModuleNotFoundError(f"{what}; {near}" if near else what, name=name)
    return _lab_module(name)


def _trainer_module(name: str, file: str) -> ModuleType | None:
    """Return a module of a library of agents: the installed one, or else a replacement.

    Return None if the repository of the task has such a module itself.
    """
    top, _, inner = name.partition(".")
    if top not in sys.modules:
        import_package(top, inner, Path(file))
    if top in sys.modules and is_task_package(top):
        return None
    try:
        return _extended_module(name)
    except ModuleNotFoundError as error:
        if str(error.name).partition(".")[0] != top:
            raise
        return absent_module(name)


@functools.cache
def _extended_module(name: str) -> ModuleType:
    """Return an installed module to which replacements for names of other versions of its library are added."""
    installed = importlib.import_module(name)
    module = absent_module(name)
    vars(module).update({key: value for key, value in vars(installed).items() if key != "__getattr__"})
    return module


def _of_source(name: str, folder: Path, inner: str) -> ModuleType:
    """Import a module of `isaaclab_tasks` or `isaaclab_assets` from the original files in a folder.

    Raises:
        ModuleNotFoundError: if the package has no such module.
    """
    top = name.partition(".")[0]
    try:
        # the __init__.py of isaaclab_tasks imports every task, so that file is not run
        return import_from(folder, inner, run_start=top != "isaaclab_tasks")
    except ModuleNotFoundError as error:
        if not str(error.name).endswith(f".{inner}"):
            raise
        raise ModuleNotFoundError(f"Isaac Lab's package '{top}' has no module '{name}' ({folder})", name=name) from None


@functools.cache
def _source_folder(package: str, start: Path, member: str) -> Path | None:
    """Return the folder with the original files of a package; None if there is none.

    Args:
        package: name of the package. A repository may have a package of the same name: one with `member` is preferred.
        start: folder of the importing file.
        member: first module in the package that is imported; empty: only the package.
    """
    places = [*start.resolve().parents]
    if os.environ.get(SOURCE):
        places.append(Path(os.environ[SOURCE]).expanduser())
    installed = importlib.util.find_spec("isaaclab")
    places += [Path(place) / "source" for place in (installed.submodule_search_locations or ())] if installed else []
    inner = (Path(package), Path(package, package), Path("source", package, package))
    found = [place / part for place in places for part in inner if (place / part / "__init__.py").is_file()]
    whole = [f for f in found if not member or (f / member).is_dir() or (f / f"{member}.py").is_file()]
    return next(iter(whole or found), None)


@functools.cache
def _lab_module(name: str) -> LabModule:
    module = LabModule(name, f"Names of `{name}`.")
    module.__path__ = []
    return module


def _member(module: str, name: str) -> Any:
    path = f"{module}.{name}"
    if name in _LIBRARY_NAMES and name in _STAR_NAMES.get(module, ()):
        home = _LIBRARY_NAMES[name]
        found = _lab_module(home) if home.startswith("isaaclab") else importlib.import_module(home)
        return getattr(found, name, found)
    if path not in _modules() and name not in _definitions():  # the package re-exports a module of a subpackage
        below = (found for found in sorted(_modules()) if found.startswith(f"{module}.") and found.endswith(f".{name}"))
        path = next(below, path)
    for candidate in _homes(module):
        value = getattr(candidate, name, None)
        if value is not None and not (isinstance(value, ModuleType) and path in _modules()):
            return value
    if path in _modules():
        return _lab_module(path)
    if _definitions().get(name) is None:
        raise _UnknownNameError(name, module)
    return lab_name(name)


class _UnknownNameError(AttributeError):
    """Error for a name that Isaac Lab lacks. The slow search for similar names runs only if the error is printed."""

    def __str__(self) -> str:
        name, module = self.args
        near = did_you_mean(name, public_names(module)) or did_you_mean(name, list(_definitions()))
        return f"Isaac Lab 2.3.2 has no '{name}' in '{module}'" + (f"; {near}" if near else "")


@functools.cache
def lab_name(name: str) -> Any:
    """Return the object for a public name of Isaac Lab, from whichever module defines the name."""
    from rlcli_isaaclab import vocabulary

    if hasattr(vocabulary, name):
        return getattr(vocabulary, name)
    module, kind = _definitions()[name]
    for candidate in _homes(module):
        value = getattr(candidate, name, None)
        if value is not None and not isinstance(value, ModuleType):
            return value
    if isinstance(kind, Mapping):
        return _settings_class(name, kind, f"{module}.{name}")
    make = {"class": absent_class, "function": absent_function}.get(kind, absent_value)
    return make(f"{module}.{name}")


def _settings_class(name: str, kind: Mapping[str, Any], full: str, qualified: str | None = None) -> Any:
    """Return a configuration class of Isaac Lab that rlcli does not define, from its entry in `names.json`.

    The code that reads the configuration reports settings that rlcli cannot use.
    """
    bases = tuple(base for base in map(_base, kind["bases"]) if isinstance(base, type)) or (object,)
    members: dict[str, Any] = {"__doc__": f"Settings of Isaac Lab's `{full}`.", "__module__": f"{_OWN}.namespace"}
    qualified = full.rpartition(".")[2] if qualified is None else qualified
    members["__qualname__"] = qualified
    for inner, content in kind.get("nested", {}).items():
        members[inner] = _settings_class(inner, content, f"{full}.{inner}", f"{qualified}.{inner}")
    fields = dict(kind.get("fields", {}))
    known = {field for base in bases for field in getattr(base, "__dataclass_fields__", {})}
    # null in the table is a value that JSON cannot store; then the default of a base class is a better guess
    fields = {key: value for key, value in fields.items() if not (value is None and key in known)}
    if name.endswith("Cfg") and "class_type" not in fields and full.count(".") and not name[0].islower():
        fields.setdefault("class_type", name.removesuffix("Cfg"))
    fields = {key: _tuple(value) for key, value in fields.items()}
    if fields.get("class_type", "") is None:
        fields["class_type"] = name.removesuffix("Cfg")
    if fields.get("func", "") is None:
        fields["func"] = f"isaaclab:{name}"
    return configclass(type(name, bases, {**members, "__annotations__": {}, **fields}))


def _base(written: str) -> Any:
    """Return a base class by its text in `names.json`: `Name`, `module.Name` or `Name.Nested`."""
    parts = written.split(".")
    while len(parts) > 1 and parts[0] not in _definitions():
        parts = parts[1:]
    found = lab_name(parts[0]) if parts[0] in _definitions() else None
    for part in parts[1:]:
        found = getattr(found, part, None)
    return found


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) and value and not isinstance(value[0], str) else value


@functools.cache
def _homes(module: str) -> tuple[Any, ...]:
    """Return the modules of this package that define the names of a module of Isaac Lab."""
    parts = module.split(".")
    names = [extra for prefix, extras in _EXTRA.items() for extra in extras if f"{module}.".startswith(f"{prefix}.")]
    if parts[0] == "isaaclab":
        for length in range(len(parts), 1, -1):
            path = ".".join(parts[1:length])
            if (Path(__file__).parent / path.replace(".", "/")).with_suffix(".py").is_file() or (
                Path(__file__).parent / path.replace(".", "/") / "__init__.py"
            ).is_file():
                names.append(path)
    if ".mdp" in module:
        names.append("mdp")
    return tuple(importlib.import_module(f"{_OWN}.{name}") for name in dict.fromkeys(names))


@functools.cache
def _table() -> dict[str, dict[str, Any]]:
    table: dict[str, dict[str, Any]] = json.loads((Path(__file__).parent / "names.json").read_text(encoding="utf-8"))
    return table


@functools.cache
def _modules() -> frozenset[str]:
    """Return the names of all modules of Isaac Lab and of the packages that contain them."""
    return frozenset(".".join(name.split(".")[:n]) for name in _table() for n in range(1, name.count(".") + 2))


@functools.cache
def _definitions() -> dict[str, tuple[str, Any]]:
    """Return name -> (module that defines it, its entry in `names.json`). Names of isaaclab itself win over others."""
    found: dict[str, tuple[str, Any]] = {}
    for module, names in sorted(_table().items(), key=lambda item: item[0].split(".")[0] != "isaaclab"):
        for name, kind in names.items():
            if name != "logger":
                found.setdefault(name, (module, kind))
    return found


@functools.cache
def public_names(module: str) -> list[str]:
    """Return the names that `from module import *` imports: those of the module and the modules below it."""
    below = [names for name, names in _table().items() if f"{name}.".startswith(f"{module}.")]
    own = {name for names in below for name in names if name != "logger" and not name.startswith("_")}
    return sorted(own.union(_STAR_NAMES.get(module, ())))

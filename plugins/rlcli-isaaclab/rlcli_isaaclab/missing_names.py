"""Replacements for names of Isaac Lab and Isaac Sim that rlcli does not have. Using them raises an error."""

from __future__ import annotations

import functools
import importlib.util
import sys
import traceback
from types import ModuleType
from typing import Any

from rlcli.errors import TaskError, pip_install
from rlcli.registry.framework_imports import TaskFileLoader
from rlcli_isaaclab.format import LIBRARIES, TRAINERS

_REASONS = {
    "pink": ("Pink inverse kinematics needs Pinocchio", "use DifferentialInverseKinematicsActionCfg"),
    "pinocchio": ("rlcli does not use Pinocchio", "use DifferentialInverseKinematicsActionCfg"),
    "rmp": ("RMPflow is a part of Isaac Sim", "use DifferentialInverseKinematicsActionCfg"),
    "surface_gripper": ("a suction gripper has no counterpart in plain MuJoCo", "use a gripper with joints"),
    "devices": ("devices for teleoperation belong to Isaac Sim", "rlcli trains policies: remove the use of the device"),
    "recorder": ("recorders write files of Isaac Lab", "use `rlcli eval --record`"),
    "pretrainedpolicy": (
        "it loads a TorchScript policy, and rlcli unpickles nothing",
        "train the low-level policy, and write the task without it",
    ),
    "nonholonomic": ("rlcli has no action for wheeled bases", "use JointVelocityActionCfg"),
    "surfacegripper": ("a suction gripper has no counterpart in plain MuJoCo", "use a gripper with joints"),
    "image_features": ("its networks are downloads in TorchScript or pickles", "train a CNN on `mdp.image`"),
    "agile": (
        "it loads a TorchScript policy, and rlcli unpickles nothing",
        "train the low-level policy, and write the task without it",
    ),
    "output[": ("rlcli's cameras have no such images", "use rgb, depth, distance_to_image_plane or distance_to_camera"),
    "nodal": ("rlcli simulates rigid bodies only", "replace the soft body by a rigid one"),
    "deformable": ("rlcli simulates rigid bodies only", "replace the soft body by a rigid one"),
    "omni": ("it belongs to Isaac Sim's USD stage", "change the model (MJCF) instead"),
    "pxr": ("it belongs to Isaac Sim's USD stage", "change the model (MJCF) instead"),
    "carb": ("it belongs to Isaac Sim", "remove its use"),
    "isaacsim": ("it belongs to Isaac Sim", "remove its use"),
    "subclass of mdp.": ("rlcli's own terms are not classes", "use the term itself, or derive from ManagerTermBase"),
    "marl": ("rlcli has no multi-agent tasks", "write a task with one agent"),
}
"""Part of a name -> the reason why rlcli does not have it, and what to do."""


def reason_of(name: str) -> tuple[str, str]:
    """Return the reason why rlcli does not have a name of Isaac Lab or Isaac Sim, and a hint what to do instead."""
    top = name.partition(".")[0]
    library = "trimesh" if top == "trimesh" else LIBRARIES.get(top)
    if library is not None:
        return "the library is not installed", pip_install(library)
    if top in TRAINERS:
        what = f"the installed {top} does not have it" if importlib.util.find_spec(top) else f"{top} is not installed"
        return what, f"install the version of {top} that the task needs, or train with another agent"
    words = name.lower()
    return next(
        (texts for part, texts in _REASONS.items() if part in words),
        ("plain MuJoCo and rlcli have no counterpart", "docs/guides/isaac-lab.md lists the names that can be used"),
    )


def absence(name: str, hint: str | None = None) -> TaskError:
    """Return the error for using a name of Isaac Lab or Isaac Sim that rlcli does not have.

    `hint` replaces the hint that `reason_of` returns.
    """
    reason, usual = reason_of(name)
    return TaskError(f"{user_place()}{name} cannot be used: {reason}", hint=hint or usual)


class MissingMemberError(AttributeError):
    """Error for a member of an asset or sensor that rlcli does not have."""

    def __init__(self, message: str, hint: str) -> None:
        super().__init__(message)
        self.hint = hint


def user_place() -> str:
    """Return `file:line: ` of the innermost line of the task's code that is running; empty if none is."""
    from rlcli.registry import is_framework

    frame = sys._getframe(2)
    while frame is not None:
        file, module = frame.f_code.co_filename, str(frame.f_globals.get("__name__", ""))
        if not is_framework(module) and not file.startswith("<") and not module.startswith(("importlib", "torch")):
            return f"{file}:{frame.f_lineno}: "
        frame = frame.f_back  # type: ignore[assignment]
    return ""


def place_of(error: BaseException) -> str:
    """Return `file:line: ` of the innermost line of a task's file in an error's traceback; empty if there is none."""
    found = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        if isinstance(frame.f_globals.get("__loader__"), TaskFileLoader):
            found = f"{frame.f_code.co_filename}:{line}: "
    return found


class _AbsentMeta(type):
    """Metaclass of the objects that replace classes of Isaac Lab that rlcli does not have.

    The attributes of a replacement are `AbsentValue`s. A task may subclass it, but not create objects of the subclass.
    """

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return AbsentValue(f"{type.__getattribute__(cls, '__doc__')}.{name}")

    def __call__(cls, *args: Any, **settings: Any) -> Any:
        if "absent_name" not in vars(cls):  # a class of the task that derives from a replaced class
            raise absence(str(getattr(cls, "absent_name", cls.__name__)))
        return AbsentValue(str(cls.__doc__))


class AbsentValue:
    """Replacement for a constant or function of Isaac Lab that rlcli does not have.

    Code may copy it, store it, pass it to functions and read its attributes; calling it raises a TaskError.
    """

    absent_name: str
    imported_at: str
    """`file:line: ` of the import of a name of `isaaclab_assets`, else empty."""

    def __init__(self, name: str, imported_at: str = "") -> None:
        self.__dict__["absent_name"], self.__dict__["imported_at"] = name, imported_at
        self.__dict__["__name__"] = name.rpartition(".")[2]

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name in ("copy", "replace"):
            return lambda **changes: self
        return AbsentValue(f"{self.absent_name}.{name}")

    def __setattr__(self, name: str, value: Any) -> None:
        """Accept any setting: nothing reads it."""

    def __getitem__(self, key: Any) -> Any:
        return AbsentValue(f"{self.absent_name}[{key!r}]")

    def __setitem__(self, key: Any, value: Any) -> None:
        """Accept any setting: nothing reads it."""

    def __deepcopy__(self, memo: Any) -> AbsentValue:
        return self

    def __or__(self, other: Any) -> Any:
        return self

    __ror__ = __add__ = __radd__ = __or__

    def __call__(self, *args: Any, **settings: Any) -> Any:
        """Raise TaskError: rlcli does not have the class or function that this object replaces."""
        raise absence(self.absent_name)

    def __repr__(self) -> str:
        return f"<{self.absent_name}, not available in rlcli>"


class AbsentModule(ModuleType):
    """Replacement for a module of Isaac Sim. Any name can be imported from it; using the name raises an error."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if self.__name__.endswith("settings") and name in ("get_settings", "acquire_settings_interface"):
            return _NoSettings
        if self.__name__ == "pxr" and name == "UsdGeom":
            from rlcli_isaaclab.usd_geometry import UsdGeom

            return UsdGeom
        if self.__name__ == "isaacsim.core.utils.prims" and name == "create_prim":
            from rlcli_isaaclab.setup_scene import create_prim

            return create_prim
        if name[:1].isupper():
            return absent_class(f"{self.__name__}.{name}")
        if self.__name__ in ("carb", "omni.log") and name.startswith(("log", "info", "warn", "error", "verbose")):
            return _log
        from rlcli_isaaclab.namespace import module_of

        return module_of(f"{self.__name__}.{name}", "")

    def __call__(self, *args: Any, **settings: Any) -> Any:
        """Raise TaskError: rlcli does not have the class or function that this object replaces."""
        raise absence(self.__name__)


@functools.cache
def absent_module(name: str) -> AbsentModule:
    """Return an object that replaces a module of Isaac Lab or Isaac Sim that rlcli does not have."""
    module = AbsentModule(name)
    module.__path__ = []
    return module


def absent_class(name: str) -> type:
    """Return a replacement for a class that rlcli lacks: it can be subclassed, and a call returns an `AbsentValue`."""
    return _AbsentMeta(name.rpartition(".")[2], (), {"__doc__": name, "absent_name": name, "__module__": __name__})


def absent_value(name: str) -> AbsentValue:
    """Return an object that replaces a constant of Isaac Lab that rlcli does not have."""
    return AbsentValue(name)


def absent_function(name: str) -> AbsentValue:
    """Return an object that replaces a function of Isaac Lab that rlcli does not have."""
    return AbsentValue(name)


class _NoSettings:
    """Replacement for the settings of Isaac Sim's application, in which every setting is unset."""

    def get(self, name: str) -> None:
        """Return None."""

    def set(self, name: str, value: Any) -> None:
        """Do nothing."""

    get_as_bool = get_as_string = get_as_int = get
    set_bool = set_string = set_int = set


class NoEffect:
    """Replacement for a USD prim, or a part of a prim, that only changes how a scene looks: calls do nothing."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return NoEffect(f"{self._name}.{name}")

    def __call__(self, *args: Any, **settings: Any) -> Any:
        """Report the first call, and do nothing."""
        report_once(f"{self._name} has no effect: rlcli's lights and colours do not change")
        return self


@functools.cache
def report_once(text: str) -> None:
    """Print a warning, once in a process."""
    import logging

    logging.getLogger("rlcli.isaaclab").warning("%s", text)


def _log(*texts: Any) -> None:
    import logging

    logging.getLogger("rlcli.isaaclab").info("%s", " ".join(map(str, texts)))

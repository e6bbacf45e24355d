"""Names of USD and Omniverse that task files import: vectors, poses, loggers, and names without a counterpart."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from rlcli.errors import TaskError
from rlcli_oige.prim_paths import BASE
from rlcli_oige.stage import get_current_stage, note_ignored
from rlcli_oige.usd_schemas import SchemaModule
from rlcli_oige.user_code import user_location

if TYPE_CHECKING:
    from rlcli_oige.stage import Prim, Stage

_LOG = logging.getLogger("rlcli_oige")


@dataclass
class ArticulationAction:
    """Targets and efforts of a robot's joints, for `apply_action`."""

    joint_positions: Any = None
    joint_velocities: Any = None
    joint_efforts: Any = None
    joint_indices: Any = None


class Missing(type):
    """Class of names that rlcli does not have. They can be imported; their use raises an error with the user's line.

    A new name is created as `Missing(name, (), {"reason": ...})`.
    """

    reason: str

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        """Raise a TaskError: the called name has no counterpart in rlcli."""
        raise cls._error()

    def __getattr__(cls, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise cls._error(f".{name}")

    def _error(cls, attribute: str = "") -> TaskError:
        base = next(kind for kind in reversed(cls.__mro__) if isinstance(kind, Missing))
        name = f"{base.__module__}.{base.__name__}{attribute}"
        if base is not cls:
            name = f"{cls.__name__}, a {name}"
        hint = "change the task so that it does not use this name"
        return TaskError(f"{user_location()}rlcli has no counterpart of {name}: {base.reason}", hint=hint)


class Ignored:
    """Replacement for a class or function of Omniverse that has no effect in MuJoCo.

    Calls are recorded and return the object itself; so does each of its attributes.
    """

    def __init__(self, name: str, reason: str) -> None:
        self._name, self._reason = name, reason

    def __call__(self, *args: Any, **kwargs: Any) -> Ignored:
        """Record the call, and return the object itself."""
        note_ignored(self._name, self._reason)
        return self

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return self

    def __mro_entries__(self, bases: tuple[Any, ...]) -> tuple[type, ...]:
        return (object,)


class Vector(np.ndarray):
    """Counterpart of `Gf.Vec2f` to `Gf.Vec4d`: a numpy array."""

    def __new__(cls, *values: Any) -> Vector:
        """Return a vector of numbers, or of another vector."""
        return np.array(values[0] if len(values) == 1 else values, dtype=float).reshape(-1).view(cls)


class Quaternion:
    """A quaternion of USD: real part and imaginary part."""

    def __init__(self, real: float = 1.0, *imaginary: Any) -> None:
        self.real = float(real)
        self.imaginary = Vector(*imaginary) if imaginary else Vector(0.0, 0.0, 0.0)

    def GetReal(self) -> float:  # noqa: N802  (USD's names)
        """Return the real part."""
        return self.real

    def GetImaginary(self) -> Vector:  # noqa: N802
        """Return the imaginary part."""
        return self.imaginary


class Transform:
    """World pose of a prim of the first environment, with all joints of its model at 0."""

    def __init__(self, prim: Prim) -> None:
        owner = prim.owner
        pos, quat = np.array(owner.pos), np.array(owner.quat) / np.linalg.norm(owner.quat)
        if prim.is_body():
            assert owner.child is not None
            model = owner.child.copy().compile()
            data = mujoco.MjData(model)
            mujoco.mj_kinematics(model, data)
            body = model.body(prim.element.name).id
            rotated, whole = np.zeros(3), np.zeros(4)
            mujoco.mju_rotVecQuat(rotated, data.xpos[body], quat)
            mujoco.mju_mulQuat(whole, quat, data.xquat[body])
            pos, quat = pos + rotated, whole
        environment = "/".join(prim.prim_path.split("/")[:4])
        if prim.prim_path.startswith(f"{BASE}/") and prim.prim_path != environment:
            pos = pos + prim.stage.position(prim.stage.GetPrimAtPath(environment))
        self._pos, self._quat = pos, quat

    def ExtractTranslation(self) -> Vector:  # noqa: N802
        """Return the position [m]."""
        return Vector(self._pos)

    def ExtractRotationQuat(self) -> Quaternion:  # noqa: N802
        """Return the orientation as a `Quaternion`."""
        return Quaternion(self._quat[0], self._quat[1:])


class _Gf:
    Vec2f = Vec2d = Vec3f = Vec3d = Vec3h = Vec4f = Vec4d = Vector
    Quatf = Quatd = Quath = Quaternion

    def __getattr__(self, name: str) -> Any:
        return missing("pxr.Gf", name)


class _Sdf:
    Path = str

    def __getattr__(self, name: str) -> Any:
        return Ignored(f"Sdf.{name}", "rlcli has no USD stage")


class _Usd:
    def __getattr__(self, name: str) -> Any:
        return missing("pxr.Usd", name)

    @staticmethod
    def PrimRange(prim: Prim) -> list[Prim]:  # noqa: N802
        """Return a prim and all prims below it."""
        return [prim, *(part for child in prim.GetChildren() for part in _Usd.PrimRange(child))]


class _Carb:
    """Omniverse's logger, which writes to Python's logging."""

    def log_error(self, message: str) -> None:
        """Log an error."""
        _LOG.error(message)

    def log_warn(self, message: str) -> None:
        """Log a warning."""
        _LOG.warning(message)

    def log_info(self, message: str) -> None:
        """Log a message."""
        _LOG.info(message)

    def __getattr__(self, name: str) -> Any:
        return missing("carb", name)


class UsdContext:
    """The result of `omni.usd.get_context()`."""

    def get_stage(self) -> Stage:
        """Return the stage of the task."""
        return get_current_stage()


def missing(module: str, name: str, reason: str = "it belongs to Omniverse") -> Any:
    """Return the replacement of a name that rlcli does not have: it can be imported, and its use raises a TaskError.

    Args:
        module: module of Omniverse or USD that the task imports from.
        name: the name.
        reason: why rlcli does not have it, for the error.
    """
    if name.startswith("__"):
        raise AttributeError(name)
    return Missing(name, (), {"reason": reason, "__module__": module})


carb, Gf, Sdf, Usd = _Carb(), _Gf(), _Sdf(), _Usd()
PhysxSchema, UsdGeom, UsdPhysics = SchemaModule("PhysxSchema"), SchemaModule("UsdGeom"), SchemaModule("UsdPhysics")
UsdLux = Ignored("UsdLux", "scene.lights sets the lights")
UsdShade = Ignored("UsdShade", "materials are part of the MJCF model")

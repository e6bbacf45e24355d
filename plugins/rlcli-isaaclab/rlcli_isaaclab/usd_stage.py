"""Poses of prims, which tasks read from the USD stage while they start."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from rlcli.errors import TaskError
from rlcli_isaaclab.absent import absence
from rlcli_isaaclab.direct_env import MANAGED


class Prim:
    """A body of the first environment, named by the last part of a path."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise absence(f"pxr.Usd.Prim.{name}")

    def pose(self) -> tuple[Any, Any]:
        """Return position [m] and quaternion (w, x, y, z) in the world frame."""
        name = self.path.rstrip("/").rsplit("/", 1)[-1]
        for entity in MANAGED.get().entities.values():
            bodies = list(entity.names["Bodies"])
            if name in bodies:
                index = bodies.index(name)
                return entity.data.body_pos_w[0, index], entity.data.body_quat_w[0, index]
            if name.lower() == entity.name:
                return entity.data.root_pos_w[0], entity.data.root_quat_w[0]
        raise TaskError(f"no body '{name}' for the prim {self.path}", hint="name a body of the MJCF like the prim")


class Stage:
    """Replacement of the USD stage: its prims are the bodies of the first environment."""

    def GetPrimAtPath(self, path: Any) -> Any:  # noqa: N802
        """Return the prim of a path: the root of an entity, or else a body."""
        from rlcli_isaaclab.usd_geometry import prims_below

        name = str(path).rstrip("/").rsplit("/", 1)[-1].lower()
        return prims_below(str(path))[0] if name in MANAGED.get().entities else Prim(str(path))


class _Xformable:
    def __init__(self, prim: Prim) -> None:
        self._prim = prim

    def ComputeLocalToWorldTransform(self, time: Any = None) -> Any:  # noqa: N802
        """Return the pose of the body."""
        position, quat = self._prim.pose()
        w, x, y, z = quat.tolist()
        turn = SimpleNamespace(real=w, imaginary=(x, y, z), GetReal=lambda: w, GetImaginary=lambda: (x, y, z))
        return SimpleNamespace(
            ExtractTranslation=position.tolist, ExtractRotationQuat=lambda: turn, ExtractRotation=lambda: turn
        )


UsdGeom = SimpleNamespace(Xformable=_Xformable)


def get_current_stage(fabric: bool = False) -> Stage:
    """Return the replacement of the USD stage."""
    return Stage()

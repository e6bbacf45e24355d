"""Replacement for the USD stage, for tasks that read the poses of prims when they start."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from rlcli.errors import TaskError
from rlcli_isaaclab.direct_env import MANAGED
from rlcli_isaaclab.missing_names import absence


def _entities() -> Any:
    """Return the entities of the environment that is being built: name -> entity."""
    managed = MANAGED.get(None)
    if managed is None:
        raise absence("the USD stage after the start", hint="read the pose of the asset from its `data`")
    return managed.entities


class Prim:
    """Prim of a body or entity in the first environment; the last part of its path is the name."""

    def __init__(self, path: str) -> None:
        self.path = path

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise absence(f"pxr.Usd.Prim.{name}")

    def pose(self) -> tuple[Any, Any]:
        """Return position (3,) [m] and quaternion (w, x, y, z) of the body in the world frame."""
        name = self.path.rstrip("/").rsplit("/", 1)[-1]
        for entity in _entities().values():
            bodies = list(entity.names["Bodies"])
            if name in bodies:
                index = bodies.index(name)
                return entity.data.body_pos_w[0, index], entity.data.body_quat_w[0, index]
            if name.lower() == entity.name:
                return entity.data.root_pos_w[0], entity.data.root_quat_w[0]
        hint = "rename a body of the MJCF: its name must be the last part of the prim path"
        raise TaskError(f"the prim {self.path} does not exist: no entity has a body '{name}'", hint=hint)


class Stage:
    """Replacement for the USD stage: its prims are the bodies of the first environment."""

    def GetPrimAtPath(self, path: Any) -> Any:  # noqa: N802
        """Return the prim of a path, whose last part is the name of an entity or of a body."""
        from rlcli_isaaclab.usd_geometry import prims_below

        name = str(path).rstrip("/").rsplit("/", 1)[-1].lower()
        return prims_below(str(path))[0] if name in _entities() else Prim(str(path))


class _Xformable:
    def __init__(self, prim: Prim) -> None:
        self._prim = prim

    def ComputeLocalToWorldTransform(self, time: Any = None) -> Any:  # noqa: N802
        """Return the pose of the prim in the world frame, as an object with the methods of a USD matrix."""
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

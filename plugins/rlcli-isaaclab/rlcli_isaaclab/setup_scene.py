"""Record of the assets and sensors that a direct task creates in its method `_setup_scene`.

The method is called twice: first to record what the scene must contain, and again after the simulation is built, to
connect the new objects with its entities and sensors.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from typing import Any

from rlcli.errors import TaskError
from rlcli_isaaclab.missing_names import absence


class Setup:
    """Assets, sensors and spawned objects of one call of `_setup_scene`, in order.

    Args:
        bind: receives each object and its position among the objects; None: the call only records.
    """

    def __init__(self, bind: Callable[[Any, int], None] | None = None) -> None:
        self._bind = bind
        self.created: list[tuple[Any, Any]] = []
        """Object and configuration of each asset, sensor and terrain."""
        self.spawned: list[tuple[str, Any, dict[str, Any]]] = []
        """Prim path, configuration and pose of prims that the task spawns with a function, without an asset object."""

    def add(self, created: Any, cfg: Any) -> None:
        """Store an object; if the simulation exists, bind the object to its entity, sensor or terrain."""
        created.cfg = cfg
        self.created.append((created, cfg))
        if self._bind is not None:
            self._bind(created, len(self.created) - 1)


_CURRENT: ContextVar[Setup | None] = ContextVar("setup", default=None)


def current_setup() -> Setup:
    """Return the `Setup` of the `_setup_scene` that is running.

    Raises:
        TaskError: outside of `_setup_scene`.
    """
    setup = _CURRENT.get()
    if setup is None:
        raise TaskError("an asset was created outside of _setup_scene", hint="create it in _setup_scene")
    return setup


@contextlib.contextmanager
def running(setup: Setup) -> Iterator[None]:
    """Make a setup the current one inside the `with` block."""
    token = _CURRENT.set(setup)
    try:
        yield
    finally:
        _CURRENT.reset(token)


class Spawn:
    """Replacement for a function of Isaac Lab that creates a prim, such as a light, from a configuration."""

    def __init__(self, name: str) -> None:
        self.__name__ = self.__qualname__ = name

    def __deepcopy__(self, memo: Any) -> Spawn:
        return self

    def __reduce__(self) -> Any:
        return Spawn, (self.__name__,)

    def __call__(
        self, prim_path: str, cfg: Any, translation: Any = None, orientation: Any = None, **other: Any
    ) -> None:
        """Record the prim in the running `Setup`; the arguments are those of Isaac Lab's function."""
        pose = {"pos": translation or (0.0, 0.0, 0.0), "rot": orientation or (1.0, 0.0, 0.0, 0.0)}
        current_setup().spawned.append((prim_path, cfg, pose))


def create_prim(
    prim_path: str,
    prim_type: str = "Xform",
    position: Any = None,
    translation: Any = None,
    orientation: Any = None,
    scale: Any = None,
    usd_path: str | None = None,
    **other: Any,
) -> None:
    """Record a new prim with a USD file in the running `Setup`; do nothing for a prim that only groups other prims.

    Raises:
        TaskError: for a prim of another type, which rlcli does not have.
    """
    if usd_path is not None:
        from rlcli_isaaclab.sim import UsdFileCfg

        pose = translation if position is None else position
        spawn_from_usd(prim_path, UsdFileCfg(usd_path=usd_path, scale=scale), pose, orientation)
    elif prim_type not in ("Xform", "Scope"):
        raise absence(f"create_prim of the type {prim_type}")


def clone(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function itself. Isaac Lab's decorator copies a spawned prim to all environments.

    In rlcli all environments have the same model.
    """
    return function


apply_nested = clone
spawn_ground_plane, spawn_light, spawn_from_usd = map(Spawn, ("spawn_ground_plane", "spawn_light", "spawn_from_usd"))

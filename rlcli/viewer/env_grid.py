"""What is drawn beside the environment shown: the others, on the grid of `env_spacing`, and the markers of all."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from rlcli.envs.build import grid
from rlcli.envs.vec_env import VecEnv
from rlcli.viewer.draw_markers import add_markers

_GROUND = (int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD))
_MOVING = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
_FIXED = int(mujoco.mjtCatBit.mjCAT_STATIC)
_FIELDS = [name for name in dir(mujoco.MjvGeom) if not name.startswith("_")]


@dataclass(frozen=True, slots=True)
class EnvGrid:
    """Which environments are drawn, and where.

    Args:
        env: the environments.
        count: how many are in the picture; the one shown is the first of them.
    """

    env: VecEnv
    count: int

    def others(self, shown: int) -> list[int]:
        """The environments beside the one shown."""
        return [(shown + place) % self.env.num_envs for place in range(1, self.count)]

    def offsets(self) -> NDArray[np.float64]:
        """How far each is moved from where it is in its world: on terrain, which all share, by 0. (count, 3) [m]"""
        if self.env.terrain is not None:
            return np.zeros((self.count, 3))
        places = grid(self.count, self.env.config.scene.env_spacing).double().numpy()
        offsets: NDArray[np.float64] = places - places[0]
        return offsets

    def fit_camera(self, camera: mujoco.MjvCamera, shown: int = 0) -> mujoco.MjvCamera:
        """A camera that looks at the one shown, moved so that it has all in the picture."""
        places = self.offsets()
        if self.env.terrain is not None:
            starts = self.env.origins.double().cpu().numpy()
            places = starts[[shown, *self.others(shown)]] - starts[shown]
        low, high = places.min(axis=0), places.max(axis=0)
        camera.lookat[:] += (low + high) / 2.0
        camera.distance += 1.2 * float((high - low).max())
        return camera

    def add(self, scene: mujoco.MjvScene, shown: int, option: mujoco.MjvOption) -> None:
        """Append the others, and the markers of all, to a scene that holds the one shown and with it the ground."""
        add_markers(scene, self.env.markers(), [shown, *self.others(shown)], self.offsets())
        category = _MOVING if self.env.terrain is not None else _MOVING | _FIXED
        for number, offset in zip(self.others(shown), self.offsets()[1:], strict=True):
            model, data = self.env.world(number)
            begin = scene.ngeom
            mujoco.mjv_addGeoms(model, data, option, mujoco.MjvPerturb(), category, scene)
            for place in range(scene.ngeom - 1, begin - 1, -1):
                geom = scene.geoms[place]
                if geom.type in _GROUND:
                    scene.ngeom -= 1
                    _copy(scene.geoms[scene.ngeom], geom)
                else:
                    geom.pos[:] += offset

    def geoms(self, scene: mujoco.MjvScene, shown: int, option: mujoco.MjvOption) -> Iterator[mujoco.MjvGeom]:
        """What `add` draws, each a copy of its own, as many as a scene that is overwritten has room for."""
        scene.ngeom = 0
        self.add(scene, shown, option)
        for source in scene.geoms[: scene.ngeom]:
            geom = mujoco.MjvGeom()
            _copy(source, geom)
            yield geom


def _copy(source: mujoco.MjvGeom, target: mujoco.MjvGeom) -> None:
    for name in _FIELDS:
        value = getattr(source, name)
        if isinstance(value, np.ndarray):
            getattr(target, name)[:] = value
        else:
            setattr(target, name, value)

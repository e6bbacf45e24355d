"""Grid of several environments in one image of a viewer or video: the shown environment and the next ones by index."""

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
    """Environments that are drawn together in an image, on a grid with the task's `env_spacing`.

    In all methods, `shown` is the index of the shown environment, the first one of the grid. The environments with the
    next indices follow.

    Args:
        env: the environments.
        count: number of environments in the image, including the shown one.
    """

    env: VecEnv
    count: int

    def others(self, shown: int) -> list[int]:
        """Return the indices of the other environments in the image, `count` - 1; 0 follows the last index."""
        return [(shown + number) % self.env.num_envs for number in range(1, self.count)]

    def offsets(self) -> NDArray[np.float64]:
        """Return the vector by which each environment is moved in the image. (count, 3) [m]

        With a terrain, the vectors are 0: the environments are already at different positions of the same terrain.
        """
        if self.env.terrain is not None:
            return np.zeros((self.count, 3))
        positions = grid(self.count, self.env.config.scene.env_spacing).double().numpy()
        offsets: NDArray[np.float64] = positions - positions[0]
        return offsets

    def fit_camera(self, camera: mujoco.MjvCamera, shown: int = 0) -> mujoco.MjvCamera:
        """Move a camera that looks at the shown environment, so that all environments of the grid are in the image.

        The camera is changed and returned.
        """
        positions = self.offsets()
        if self.env.terrain is not None:
            origins = self.env.origins.double().cpu().numpy()
            positions = origins[[shown, *self.others(shown)]] - origins[shown]
        low, high = positions.min(axis=0), positions.max(axis=0)
        camera.lookat[:] += (low + high) / 2.0
        camera.distance += 1.2 * float((high - low).max())
        return camera

    def add(self, scene: mujoco.MjvScene, shown: int, option: mujoco.MjvOption) -> None:
        """Append the markers and the other environments to a scene that has the shown environment and the ground.

        Args:
            scene: the scene.
            shown: index of the shown environment.
            option: visualisation options of MuJoCo.
        """
        add_markers(scene, self.env.markers(), [shown, *self.others(shown)], self.offsets())
        category = _MOVING if self.env.terrain is not None else _MOVING | _FIXED
        for number, offset in zip(self.others(shown), self.offsets()[1:], strict=True):
            model, data = self.env.world(number)
            begin = scene.ngeom
            mujoco.mjv_addGeoms(model, data, option, mujoco.MjvPerturb(), category, scene)
            # from the end: a removed geom is replaced by the last one, which must have been moved before
            for index in range(scene.ngeom - 1, begin - 1, -1):
                geom = scene.geoms[index]
                if geom.type in _GROUND:
                    scene.ngeom -= 1
                    _copy(scene.geoms[scene.ngeom], geom)
                else:
                    geom.pos[:] += offset

    def geoms(self, scene: mujoco.MjvScene, shown: int, option: mujoco.MjvOption) -> Iterator[mujoco.MjvGeom]:
        """Yield copies of the geoms that `add` appends to a scene: markers and further environments.

        Args:
            scene: a scene for the computation, which is overwritten; its `maxgeom` limits the number of geoms.
            shown: index of the shown environment.
            option: visualisation options of MuJoCo.
        """
        scene.ngeom = 0
        self.add(scene, shown, option)
        for source in scene.geoms[: scene.ngeom]:
            geom = mujoco.MjvGeom()
            _copy(source, geom)
            yield geom


def _copy(source: mujoco.MjvGeom, target: mujoco.MjvGeom) -> None:
    """Copy all fields of a geom."""
    for name in _FIELDS:
        value = getattr(source, name)
        if isinstance(value, np.ndarray):
            getattr(target, name)[:] = value
        else:
            setattr(target, name, value)

"""Renderer of environments without a window, for videos and for `render()` of Gymnasium environments.

The task's section `viewer` sets the camera and the size of the images.
"""

import contextlib
import math
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from rlcli.config.schema import ViewerConfig
from rlcli.envs.vec_env import VecEnv
from rlcli.sim.gl import open_context
from rlcli.viewer.env_grid import EnvGrid

_PARALLEL = int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)


def free_camera(viewer: ViewerConfig, origin: Sequence[float] = (0.0, 0.0, 0.0)) -> mujoco.MjvCamera:
    """Return a camera at `viewer.eye` that looks at `viewer.lookat`, both relative to the point `origin`. (3,) [m]"""
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(mujoco.MjModel.from_xml_string("<mujoco/>"), camera)
    ray = np.subtract(viewer.lookat, viewer.eye)
    camera.lookat[:] = np.add(viewer.lookat, origin)
    camera.distance = max(float(np.linalg.norm(ray)), 1e-3)
    camera.azimuth = math.degrees(math.atan2(ray[1], ray[0]))
    camera.elevation = math.degrees(math.asin(np.clip(ray[2] / camera.distance, -1.0, 1.0)))
    return camera


class Renderer(contextlib.AbstractContextManager["Renderer"]):
    """Offscreen renderer of environments; used in a `with` block, or closed with `close`.

    Args:
        model: the model of the environments.
        viewer: camera, and size of the images [pixels].
        env_grid: environments to draw together in each image; None: only one environment.

    Raises:
        MachineError: if this machine has no OpenGL backend that works.
    """

    def __init__(self, model: mujoco.MjModel, viewer: ViewerConfig, env_grid: EnvGrid | None = None) -> None:
        self._env_grid = env_grid
        self._width, self._height = viewer.width, viewer.height
        self._context, self.backend = open_context(viewer.width, viewer.height)
        count = 1 if env_grid is None else env_grid.count
        self._scene = mujoco.MjvScene(model, maxgeom=10_000 + (count - 1) * (model.ngeom + model.nsite))
        self._option = mujoco.MjvOption()
        self._camera = free_camera(viewer)
        if env_grid is not None:
            env_grid.fit_camera(self._camera)
        self._lookat = self._camera.lookat.copy()
        self._followed = followed_body(model, viewer.follow)
        self._mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._mjr)
        self._rect = mujoco.MjrRect(0, 0, viewer.width, viewer.height)

    def image(self, env: VecEnv, number: int = 0) -> NDArray[np.uint8]:
        """Return an RGB image of environment `number`, or of the grid from it on, with markers. (height, width, 3)"""
        self._compose(*env.world(number), env.origins[number].tolist())
        env_grid = EnvGrid(env, 1) if self._env_grid is None else self._env_grid
        env_grid.add(self._scene, number, self._option)
        return self._pixels()

    def draw(self, model: mujoco.MjModel, data: mujoco.MjData) -> NDArray[np.uint8]:
        """Return an RGB image of a model and its state, after `mj_forward`, without markers. (height, width, 3)"""
        self._compose(model, data, (0.0, 0.0, 0.0))
        return self._pixels()

    def _compose(self, model: mujoco.MjModel, data: mujoco.MjData, origin: Sequence[float]) -> None:
        """Fill the scene from a model and its state, and move the camera to the origin or the followed body."""
        self._camera.lookat[:] = np.add(self._lookat, origin)
        travelled = np.zeros(3)
        if self._followed is not None:
            body, start = self._followed
            travelled = data.xpos[body] - start - origin
            self._camera.lookat[:] += travelled
        everything = int(mujoco.mjtCatBit.mjCAT_ALL)
        mujoco.mjv_updateScene(model, data, self._option, None, self._camera, everything, self._scene)
        for light in self._scene.lights[: self._scene.nlight]:
            if light.type == _PARALLEL:  # MuJoCo draws shadows only around the light's position
                light.pos[:2] += travelled[:2]

    def _pixels(self) -> NDArray[np.uint8]:
        """Render the scene and return the RGB image. (height, width, 3)"""
        mujoco.mjr_render(self._rect, self._scene, self._mjr)
        pixels = np.empty((self._height, self._width, 3), np.uint8)
        mujoco.mjr_readPixels(pixels, None, self._rect, self._mjr)
        return np.ascontiguousarray(pixels[::-1])  # the first row of OpenGL is the lowest row of the image

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the OpenGL context."""
        self._mjr.free()
        self._context.free()


def followed_body(model: mujoco.MjModel, entity: str | None) -> tuple[int, NDArray[np.float64]] | None:
    """Return the id of an entity's root body and its default position, (3,) [m]; None if there is no such entity."""
    bodies = [body for body in range(model.nbody) if model.body(body).name.startswith(f"{entity}/")]
    if entity is None or not bodies:
        return None
    root = min(bodies)
    joint = model.body_jntadr[root]
    if joint >= 0 and model.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_FREE):
        address = model.jnt_qposadr[joint]
        return root, model.qpos0[address : address + 3].copy()
    return root, model.body_pos[root].copy()

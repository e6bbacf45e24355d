"""Camera sensors: images of every environment, rendered without a window.

Several threads render in parallel, each with its own OpenGL context.
"""

from __future__ import annotations

import copy
import functools
import os
import queue
import threading
import weakref
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from typing import Any

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rlcli.config.schema import CameraSensorConfig
from rlcli.errors import ConfigError, MachineError, Problem
from rlcli.scene.lazy_sensor import LazySensor
from rlcli.scene.sensor_builder import CameraSensorSpec
from rlcli.sim.engine import Engine, ReplayableEngine
from rlcli.sim.env_selection import Selection, ids_of
from rlcli.sim.gl import open_context

_CHANNELS = {"rgb": 3, "depth": 1, "distance": 1, "segmentation": 1}
_DISABLED_EFFECTS = ("mjRND_SHADOW", "mjRND_REFLECTION", "mjRND_HAZE", "mjRND_FOG")
_VISIBLE_CATEGORIES = int(mujoco.mjtCatBit.mjCAT_STATIC | mujoco.mjtCatBit.mjCAT_DYNAMIC)
_INTEGRATION_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_MAX_GEOMS = 10_000
"""Largest number of geoms that an image can show."""
_JOIN_TIMEOUT = 5.0
"""Longest time to wait for a thread to end [s]."""


class CameraSensor(LazySensor):
    """Camera that renders one image of every environment when a term reads `image`, at most once per step.

    Args:
        name: name of the sensor.
        spec: the camera in the model.
        engine: the engine whose states are rendered.
        renderers: threads that render.
    """

    def __init__(self, name: str, spec: CameraSensorSpec, engine: ReplayableEngine, renderers: RendererPool) -> None:
        super().__init__()
        self.config = config = spec.config
        self._engine, self._renderers = engine, renderers
        self._camera = engine.model.camera(spec.camera).id
        shape = (config.height, config.width, _CHANNELS[config.data])
        kind = torch.uint8 if config.data == "rgb" else torch.float32
        self.names = [name]
        """List with the sensor's name as its only item; other sensors have one name for each body or ray."""
        self._image = torch.zeros(engine.num_envs, *shape, dtype=kind)
        self._pixels = self._image.numpy()

    @property
    def image(self) -> Tensor:
        """Images, the top row first: rgb (num_envs, h, w, 3) uint8, other data (num_envs, h, w, 1) float32.

        Depth and distance are in metres; 0 means that nothing is within `clip`. Segmentation has the ids of the visible
        bodies, 0 for the world's own geoms, and -1 where nothing is visible. Where a pixel is the mean of several
        samples, samples without a hit count as 0 m.
        """
        if not self._current:
            self._current = True
            self._render(np.arange(self._engine.num_envs))
        return self._image

    def on_moved(self, selection: Selection) -> None:
        """Render again the selected environments, whose bodies were moved, if `image` has been read in this step."""
        if self._current:
            self._render(ids_of(selection))

    def close(self) -> None:
        """Free the OpenGL contexts, which all cameras of the scene share."""
        self._renderers.close()

    def _render(self, ids: NDArray[np.int64]) -> None:
        """Render the environments `ids`, an equal number in each thread."""
        engine, config, camera, pixels = self._engine, self.config, self._camera, self._pixels

        def render_share(share: NDArray[np.int64], renderer: CameraRenderer) -> None:
            for env in share.tolist():
                renderer.load_state(engine, env)
                renderer.render(camera, config, pixels[env])

        shares = np.array_split(ids, self._renderers.count)
        self._renderers.run([functools.partial(render_share, share) for share in shares if len(share)])


class CameraRenderer:
    """Renderer of camera images, with an OpenGL context that a single thread must create, use and free.

    Args:
        model: model of the scene.
        width: width of the largest image [samples].
        height: height of the largest image [samples].

    Raises:
        MachineError: if no OpenGL works on this machine.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        self._model = self._shared_model = model
        self._data = mujoco.MjData(model)
        self._context, _ = open_context(width, height, in_thread=True)
        small = copy.copy(model)  # buffers of the viewer's size would be cleared for every image
        small.vis.global_.offwidth, small.vis.global_.offheight = width, height
        small.vis.quality.offsamples, small.vis.quality.shadowsize = 0, 0
        self._mjr = mujoco.MjrContext(small, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._mjr)
        self._mjr.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._scene = mujoco.MjvScene(model, maxgeom=_MAX_GEOMS)
        for flag in _DISABLED_EFFECTS:
            self._scene.flags[getattr(mujoco.mjtRndFlag, flag)] = False
        self._view = mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._option = mujoco.MjvOption()

    def load_state(self, engine: ReplayableEngine, env: int) -> None:
        """Copy the state of environment `env`, and its own model values (such as colours), into the renderer.

        Call it before `render`.
        """
        if engine.expanded_fields():
            if self._model is self._shared_model:
                self._model = copy.copy(self._shared_model)
            engine.write_own_model(env, self._model)
        model, data = self._model, self._data
        mujoco.mj_setState(model, data, engine.state_row(env), _INTEGRATION_STATE)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        if model.nflex:
            mujoco.mj_flex(model, data)
        if model.ntendon:
            mujoco.mj_tendon(model, data)

    def render(self, camera: int, config: CameraSensorConfig, out: NDArray[Any]) -> None:
        """Render the environment that was loaded last into the array `out`. (h, w, c)

        `camera` is the camera's index in the model, `config` its configuration.
        """
        scene, flags = self._scene, mujoco.mjtRndFlag
        self._view.fixedcamid = camera
        mujoco.mjv_updateScene(self._model, self._data, self._option, None, self._view, _VISIBLE_CATEGORIES, scene)
        for view in scene.camera:
            _set_clip_planes(view, *config.clip)
        is_rgb, is_ids = config.data == "rgb", config.data == "segmentation"
        for flag in (flags.mjRND_SEGMENT, flags.mjRND_IDCOLOR):  # without light and textures, depth is exact
            scene.flags[flag] = not is_rgb
        rect = mujoco.MjrRect(0, 0, config.width * config.samples, config.height * config.samples)
        mujoco.mjr_render(rect, scene, self._mjr)
        if is_rgb or is_ids:
            pixels = np.empty((rect.height, rect.width, 3), np.uint8)
            mujoco.mjr_readPixels(pixels, None, rect, self._mjr)
            values = self._bodies(pixels) if is_ids else np.rint(_downsample(pixels, config.samples))
            out[:] = values[::-1] if is_ids else values
            return
        nearness = np.empty((rect.height, rect.width), np.float32)
        mujoco.mjr_readPixels(None, nearness, rect, self._mjr)
        depths = _depths(nearness, scene.camera[0], along_ray=config.data == "distance")
        out[:] = _downsample(depths[..., None], config.samples)

    def _bodies(self, pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the id of the body at each pixel. (h, w, 1)

        The colour of a pixel is 1 + the index of a geom in the rendered scene.
        """
        numbers = pixels.astype(np.int64) @ np.array([1, 1 << 8, 1 << 16])
        body_of = np.full(self._scene.ngeom + 2, -1.0, np.float32)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.segid >= 0 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                body_of[geom.segid + 1] = self._model.geom_bodyid[geom.objid]
        bodies: NDArray[np.float32] = body_of[np.minimum(numbers, len(body_of) - 1)][..., None]
        return bodies

    def free(self) -> None:
        """Free the OpenGL context and its buffers."""
        self._mjr.free()
        self._context.free()


class RendererPool:
    """Threads that render images in parallel; each has a `CameraRenderer`.

    Args:
        model: model of the scene.
        width: width of the largest image [samples].
        height: height of the largest image [samples].
        threads: number of threads.

    Raises:
        MachineError: if no OpenGL works on this machine.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int, threads: int) -> None:
        self._process = os.getpid()
        self._orders: list[_Orders] = []
        self._threads: list[threading.Thread] = []
        self._end = weakref.finalize(self, _end_threads, self._orders, self._threads, self._process)
        for number in range(threads):  # one after the other: the first one finds out which OpenGL works
            orders: _Orders = queue.SimpleQueue()
            ready: Future[None] = Future()
            thread = threading.Thread(
                target=_render_orders,
                args=(model, width, height, orders, ready),
                name=f"rlcli-renderer-{number}",
                daemon=True,
            )
            thread.start()
            self._orders.append(orders)
            self._threads.append(thread)
            try:
                ready.result()
            except BaseException:
                self.close()
                raise

    @property
    def count(self) -> int:
        """Number of threads that render."""
        return len(self._threads)

    def run(self, work: Sequence[Callable[[CameraRenderer], None]]) -> None:
        """Call each function in a thread of its own, with that thread's renderer as argument; wait for all of them.

        Raises:
            MachineError: after `close`, or in a fork of the process that created the pool.
        """
        if os.getpid() != self._process:
            message = "cameras render only in the process that created the environment; this process is a fork of it"
            hint = "create the environment in this process, or start the process with multiprocessing's method 'spawn'"
            raise MachineError(message, hint=hint)
        if not self._end.alive:
            raise MachineError("the environment is closed, so its cameras cannot render; create a new environment")
        futures: list[Future[None]] = [Future() for _ in work]
        for function, future, orders in zip(work, futures, self._orders, strict=False):
            orders.put((function, future))
        wait(futures)  # for all threads, before an error is raised
        for future in futures:
            future.result()

    def close(self) -> None:
        """End the threads, each of which frees its OpenGL context."""
        self._end()
        if os.getpid() == self._process:
            for thread in self._threads:
                thread.join(_JOIN_TIMEOUT)


def make_cameras(specs: Mapping[str, CameraSensorSpec], engine: Engine) -> dict[str, CameraSensor]:
    """Return the camera sensors of a compiled scene, by name.

    Raises:
        ConfigError: for an engine whose states are not on the CPU.
        MachineError: if no OpenGL works on this machine.
    """
    if not specs:
        return {}
    if (states := engine.replayable) is None:
        hint = "use --device cpu, and remove sim.engine: warp if the task sets it"
        message = "cameras need the CPU engine; the GPU engine cannot render them"
        raise ConfigError([Problem("scene", f"scene.sensors.{name}", message, hint) for name in specs])
    configs = [spec.config for spec in specs.values()]
    width, height = (max(c.samples * getattr(c, edge) for c in configs) for edge in ("width", "height"))
    renderers = RendererPool(engine.model, width, height, min(engine.threads, engine.num_envs))
    return {name: CameraSensor(name, spec, states, renderers) for name, spec in specs.items()}


_Orders = queue.SimpleQueue[tuple[Callable[[CameraRenderer], None], Future[None]] | None]
"""Queue of functions for a rendering thread to call, each with the future for its result; None ends the thread."""


def _render_orders(model: mujoco.MjModel, width: int, height: int, orders: _Orders, ready: Future[None]) -> None:
    """Create a renderer, and call each function in the queue `orders` with it; a rendering thread runs this function.

    OpenGL requires that a single thread creates, uses and frees a context. `ready` gets the error if no OpenGL works.
    """
    try:
        renderer = CameraRenderer(model, width, height)
    except BaseException as error:
        ready.set_exception(error)
        return
    ready.set_result(None)
    while (order := orders.get()) is not None:
        function, future = order
        try:
            future.set_result(function(renderer))
        except BaseException as error:
            future.set_exception(error)
        del order, function, future  # hold no reference to an environment while waiting
    renderer.free()


def _end_threads(orders: list[_Orders], threads: list[threading.Thread], process: int) -> None:
    if os.getpid() != process:
        return  # a fork has no copies of the threads
    for thread_orders in orders:
        thread_orders.put(None)
    if threading.current_thread() is threading.main_thread():
        for thread in threads:
            thread.join(_JOIN_TIMEOUT)


def _set_clip_planes(view: mujoco.MjvGLCamera, near: float, far: float) -> None:
    """Set the near and far clipping distances of a camera [m]; its field of view stays the same."""
    if not view.orthographic:
        # MuJoCo stores the field of view as lengths on the near plane
        for name in ("center", "width", "bottom", "top"):
            value = getattr(view, f"frustum_{name}") * near / view.frustum_near
            setattr(view, f"frustum_{name}", value)
    view.frustum_near, view.frustum_far = near, far


def _depths(nearness: NDArray[np.float32], view: mujoco.MjvGLCamera, *, along_ray: bool) -> NDArray[np.float32]:
    """Convert OpenGL's depth buffer, which is 1 at the near plane and 0 at the far one, to depths [m]. (h, w)

    Depths are along the camera's axis, or along the ray through each pixel; 0 where nothing is seen.
    """
    near, far = np.float32(view.frustum_near), np.float32(view.frustum_far)
    if view.orthographic:
        depths = far - nearness * (far - near)
    else:
        depths = near * far / (near + nearness * (far - near))
        if along_ray:
            height, width = nearness.shape
            depths *= _ray_lengths(height, width, view)
    depths[nearness == 0.0] = 0.0
    return depths


def _ray_lengths(height: int, width: int, view: mujoco.MjvGLCamera) -> NDArray[np.float32]:
    """Return the length of the ray through each pixel up to a depth of 1 m, the bottom row first. (h, w) [m]"""
    rows, columns = ((np.arange(count) + 0.5) / count for count in (height, width))
    half = view.frustum_width or 0.5 * (view.frustum_top - view.frustum_bottom) * width / height
    y = (view.frustum_bottom + rows * (view.frustum_top - view.frustum_bottom)) / view.frustum_near
    x = (view.frustum_center + (2.0 * columns - 1.0) * half) / view.frustum_near
    lengths: NDArray[np.float32] = np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2).astype(np.float32)
    return lengths


def _downsample(values: NDArray[Any], samples: int) -> NDArray[Any]:
    """Return an image whose pixels are means of `samples` x `samples` samples, with the top row first instead of last.

    (h x samples, w x samples, c) -> (h, w, c)
    """
    if samples > 1:
        rows = np.stack([values[k::samples] for k in range(samples)]).sum(axis=0, dtype=np.float32)
        values = np.stack([rows[:, k::samples] for k in range(samples)]).sum(axis=0) / np.float32(samples * samples)
    return values[::-1]

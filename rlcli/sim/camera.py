"""Cameras of a scene: pictures of every environment, drawn offscreen by threads with an OpenGL context each."""

from __future__ import annotations

import copy
import os
import queue
import threading
import weakref
from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np
import torch
from torch import Tensor

from rlcli.config.schema import CameraSensorConfig
from rlcli.errors import ConfigError, MachineError, Problem
from rlcli.sim.batch import BatchEngine
from rlcli.sim.gl import open_context
from rlcli.sim.mounts import CameraMount
from rlcli.sim.selection import IdSelection, Selection
from rlcli.sim.state import SimData

_CHANNELS = {"rgb": 3, "depth": 1, "distance": 1}
_OFF = ("mjRND_SHADOW", "mjRND_REFLECTION", "mjRND_HAZE", "mjRND_FOG")
_SEEN = int(mujoco.mjtCatBit.mjCAT_STATIC | mujoco.mjtCatBit.mjCAT_DYNAMIC)
_ROW = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_MOST_GEOMS = 10_000
_PATIENCE = 5.0
"""How long to wait for a thread that is to end [s]."""


class CameraSensor:
    """One picture of every environment. They are drawn when somebody looks, at most once a step.

    Args:
        name: of the sensor.
        mount: the camera in the model.
        sim: whose states are drawn.
        painters: who draws.
    """

    def __init__(self, name: str, mount: CameraMount, sim: SimData, painters: Painters) -> None:
        self.config = mount.config
        self._sim, self._painters = sim, painters
        assert isinstance(sim.engine, BatchEngine)
        self._engine = sim.engine
        self._camera = sim.engine.model.camera(mount.camera).id
        config = mount.config
        shape = (config.height, config.width, _CHANNELS[config.data])
        kind = torch.uint8 if config.data == "rgb" else torch.float32
        self.names = [name]
        """The sensor."""
        self._image = torch.zeros(sim.engine.num_envs, *shape, dtype=kind)
        self._pixels = self._image.numpy()
        self._current = False

    @property
    def image(self) -> Tensor:
        """The pictures, rows from the top. rgb: (num_envs, h, w, 3) uint8; else (num_envs, h, w, 1) float32 [m].

        Nothing within `clip` is 0 m. Where a pixel is the mean of several samples, those that see nothing count as 0 m.
        """
        if not self._current:
            self._current = True
            self._draw(np.arange(self._engine.num_envs))
        return self._image

    def update(self, dt: float) -> None:
        """The bodies have moved."""
        self._current = False

    def reset(self, selection: Selection) -> None:
        """The bodies of the selected environments have been put elsewhere."""
        self.moved(selection)

    def moved(self, selection: Selection) -> None:
        """Draw the selected environments anew, if somebody has looked in this step."""
        if self._current:
            assert isinstance(selection, IdSelection)
            self._draw(selection.ids)

    def state_dict(self) -> dict[str, Tensor]:
        """Nothing: pictures follow from the state of the bodies."""
        return {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """The bodies are where the loaded state has them."""
        self._current = False

    def close(self) -> None:
        """Let go of the contexts, which all cameras of the scene share."""
        self._painters.close()

    def _draw(self, ids: np.ndarray) -> None:
        engine, config, camera, pixels = self._engine, self.config, self._camera, self._pixels

        def share(some: np.ndarray) -> Callable[[Painter], None]:
            def work(painter: Painter) -> None:
                for env in some:
                    painter.pose(engine, int(env))
                    painter.paint(camera, config, pixels[env])

            return work

        self._painters.run([share(some) for some in np.array_split(ids, self._painters.count) if len(some)])


class Painter:
    """An OpenGL context with what it draws into; it is made, used and freed in one thread.

    Args:
        model: what is drawn.
        width: of the largest picture, in samples.
        height: likewise.

    Raises:
        MachineError: if nothing on this machine can draw.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int) -> None:
        self._model, self._own = model, None
        self._data = mujoco.MjData(model)
        self._context, _ = open_context(width, height, in_thread=True)
        small = copy.copy(model)  # buffers of the viewer's size would be cleared for every picture
        small.vis.global_.offwidth, small.vis.global_.offheight = width, height
        small.vis.quality.offsamples, small.vis.quality.shadowsize = 0, 0
        self._mjr = mujoco.MjrContext(small, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._mjr)
        self._mjr.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self._scene = mujoco.MjvScene(model, maxgeom=_MOST_GEOMS)
        for flag in _OFF:
            self._scene.flags[getattr(mujoco.mjtRndFlag, flag)] = False
        self._view = mujoco.MjvCamera()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._option = mujoco.MjvOption()

    def pose(self, engine: BatchEngine, env: int) -> None:
        """Take the state of a world, and what its model has of its own, as far as it shows."""
        if engine.expansions():
            self._own = copy.copy(self._model) if self._own is None else self._own
            engine.give_model(env, self._own)
        model, data = self._posed, self._data
        mujoco.mj_setState(model, data, engine.row(env), _ROW)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        if model.nflex:
            mujoco.mj_flex(model, data)
        if model.ntendon:
            mujoco.mj_tendon(model, data)

    def paint(self, camera: int, config: CameraSensorConfig, out: np.ndarray) -> None:
        """Draw the world that was posed last. out (h, w, c)"""
        scene, flags = self._scene, mujoco.mjtRndFlag
        self._view.fixedcamid = camera
        mujoco.mjv_updateScene(self._posed, self._data, self._option, None, self._view, _SEEN, scene)
        for eye in scene.camera:
            _clip(eye, *config.clip)
        colours = config.data == "rgb"
        for flag in (flags.mjRND_SEGMENT, flags.mjRND_IDCOLOR):  # without light and textures, depth is exact
            scene.flags[flag] = not colours
        rect = mujoco.MjrRect(0, 0, config.width * config.samples, config.height * config.samples)
        mujoco.mjr_render(rect, scene, self._mjr)
        if colours:
            pixels = np.empty((rect.height, rect.width, 3), np.uint8)
            mujoco.mjr_readPixels(pixels, None, rect, self._mjr)
            out[:] = np.rint(_mean(pixels, config.samples))
            return
        nearness = np.empty((rect.height, rect.width), np.float32)
        mujoco.mjr_readPixels(None, nearness, rect, self._mjr)
        metres = _metres(nearness, scene.camera[0], stretched=config.data == "distance")
        out[:] = _mean(metres[..., None], config.samples)

    def free(self) -> None:
        """Free the context."""
        self._mjr.free()
        self._context.free()

    @property
    def _posed(self) -> mujoco.MjModel:
        return self._model if self._own is None else self._own


class Painters:
    """Threads that draw, each with a `Painter`.

    Args:
        model: what is drawn.
        width: of the largest picture, in samples.
        height: likewise.
        threads: how many.

    Raises:
        MachineError: if nothing on this machine can draw.
    """

    def __init__(self, model: mujoco.MjModel, width: int, height: int, threads: int) -> None:
        self._process = os.getpid()
        self._orders: list[_Orders] = []
        self._threads: list[threading.Thread] = []
        self._end = weakref.finalize(self, _dismiss, self._orders, self._threads, self._process)
        for number in range(threads):  # one after the other: the first finds out which OpenGL works
            orders: _Orders = queue.SimpleQueue()
            ready: _Replies = queue.SimpleQueue()
            thread = threading.Thread(
                target=_paint, args=(model, width, height, orders, ready), name=f"rlcli-painter-{number}", daemon=True
            )
            thread.start()
            self._orders.append(orders)
            self._threads.append(thread)
            try:
                _raise(ready.get())
            except BaseException:
                self.close()
                raise

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self._threads)

    def run(self, work: Sequence[Callable[[Painter], None]]) -> None:
        """Have each piece of work done by a thread of its own.

        Raises:
            MachineError: after `close`, or in a process that was forked from the one that opened the contexts.
        """
        if os.getpid() != self._process:
            raise MachineError(
                "cameras draw in the process that made the environment, and this is a fork of it",
                hint="make the environment in the new process, or start that with 'spawn'",
            )
        if not self._end.alive:
            raise MachineError("the environment is closed: its cameras draw no more")
        done: _Replies = queue.SimpleQueue()
        for piece, orders in zip(work, self._orders, strict=False):
            orders.put((piece, done))
        replies = [done.get() for _ in work]
        for reply in replies:
            _raise(reply)

    def close(self) -> None:
        """Have the threads free their contexts and end."""
        self._end()
        if os.getpid() == self._process:
            for thread in self._threads:
                thread.join(_PATIENCE)


def make_cameras(mounts: Mapping[str, CameraMount], sim: SimData) -> dict[str, CameraSensor]:
    """The cameras that the scene has put into the model.

    Raises:
        ConfigError: on an engine whose states are not at hand.
        MachineError: if nothing on this machine can draw.
    """
    if not mounts:
        return {}
    if not isinstance(sim.engine, BatchEngine):
        hint = "--device cpu, and no sim.engine: warp"
        message = "cameras draw on a CPU: the GPU engine has none"
        raise ConfigError([Problem("scene", f"scene.sensors.{name}", message, hint) for name in mounts])
    configs = [mount.config for mount in mounts.values()]
    width, height = (max(c.samples * getattr(c, edge) for c in configs) for edge in ("width", "height"))
    engine = sim.engine
    painters = Painters(engine.model, width, height, min(engine.threads, engine.num_envs))
    return {name: CameraSensor(name, mount, sim, painters) for name, mount in mounts.items()}


_Replies = queue.SimpleQueue[BaseException | None]
_Orders = queue.SimpleQueue[tuple[Callable[[Painter], None], _Replies] | None]


def _paint(model: mujoco.MjModel, width: int, height: int, orders: _Orders, ready: _Replies) -> None:
    """The life of a thread: OpenGL wants a context made, used and freed in one."""
    try:
        painter = Painter(model, width, height)
    except BaseException as error:
        ready.put(error)
        return
    ready.put(None)
    while (order := orders.get()) is not None:
        piece, done = order
        try:
            piece(painter)
        except BaseException as error:
            done.put(error)
        else:
            done.put(None)
        del order, piece, done  # nothing of an environment is held while waiting
    painter.free()


def _dismiss(orders: list[_Orders], threads: list[threading.Thread], process: int) -> None:
    if os.getpid() != process:
        return  # the threads stayed behind in the process that forked
    for some in orders:
        some.put(None)
    if threading.current_thread() is threading.main_thread():
        for thread in threads:
            thread.join(_PATIENCE)


def _raise(reply: BaseException | None) -> None:
    if reply is not None:
        raise reply


def _clip(eye: mujoco.MjvGLCamera, near: float, far: float) -> None:
    """Move the planes between which is drawn; what the picture spans stays."""
    if not eye.orthographic:
        for name in ("center", "width", "bottom", "top"):  # measured on the near plane
            value = getattr(eye, f"frustum_{name}") * near / eye.frustum_near
            setattr(eye, f"frustum_{name}", value)
    eye.frustum_near, eye.frustum_far = near, far


def _metres(nearness: np.ndarray, eye: mujoco.MjvGLCamera, *, stretched: bool) -> np.ndarray:
    """Distances from a depth buffer that is 1 at the near plane and 0 at the far one; where nothing is seen, 0. (h, w)

    Along the axis; stretched, from the camera's place.
    """
    near, far = np.float32(eye.frustum_near), np.float32(eye.frustum_far)
    if eye.orthographic:
        metres = far - nearness * (far - near)
    else:
        metres = near * far / (near + nearness * (far - near))
        if stretched:
            height, width = nearness.shape
            metres *= _stretch(height, width, eye)
    metres[nearness == 0.0] = 0.0
    return metres


def _stretch(height: int, width: int, eye: mujoco.MjvGLCamera) -> np.ndarray:
    """How much longer the ray through a pixel is than its part along the axis, rows from the bottom. (h, w)"""
    rows, columns = ((np.arange(count) + 0.5) / count for count in (height, width))
    half = eye.frustum_width or 0.5 * (eye.frustum_top - eye.frustum_bottom) * width / height
    y = (eye.frustum_bottom + rows * (eye.frustum_top - eye.frustum_bottom)) / eye.frustum_near
    x = (eye.frustum_center + (2.0 * columns - 1.0) * half) / eye.frustum_near
    return np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2).astype(np.float32)


def _mean(values: np.ndarray, samples: int) -> np.ndarray:
    """Means of blocks, and rows from the top instead of the bottom. (h s, w s, c) -> (h, w, c)"""
    if samples > 1:
        rows = np.stack([values[k::samples] for k in range(samples)]).sum(axis=0, dtype=np.float32)
        values = np.stack([rows[:, k::samples] for k in range(samples)]).sum(axis=0) / np.float32(samples * samples)
    return values[::-1]

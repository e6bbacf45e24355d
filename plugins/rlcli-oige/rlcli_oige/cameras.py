"""Cameras of tasks with image observations: the parts of Omniverse's replicator that they use."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from rlcli.config.schema import CameraSensorConfig
from rlcli.errors import TaskError
from rlcli.scene.camera import CameraSensor
from rlcli.scene.scene import Scene
from rlcli.scene.sensor_builder import SensorBuilder
from rlcli_oige.task_yaml import relative
from rlcli_oige.user_code import Counterpart, user_location

if TYPE_CHECKING:
    from rlcli_oige.env import OigeEnv
    from rlcli_oige.stage import Prim

SENSOR = "oige_camera"
"""Name of the camera sensor in the scene."""
_APERTURE = 20.955
"""Width of a USD camera's film, if the task does not set it [mm]."""
_FOCAL_LENGTH = 50.0
"""Focal length of a USD camera, if the task does not set it [mm]."""


class Replicator:
    """`omni.replicator.core`: one RGB camera in each environment."""

    def __init__(self, env: OigeEnv) -> None:
        self._env = env
        self._path = ""
        self._resolution = (0, 0)
        self.orchestrator = SimpleNamespace(_orchestrator=SimpleNamespace(_is_started=False))
        self.create = SimpleNamespace(render_product=self._render_product)
        self.WriterRegistry = SimpleNamespace(get=lambda name: Writer())
        self.AnnotatorRegistry = SimpleNamespace(get_annotator=self._annotator)

    def listener(self, *args: Any, **kwargs: Any) -> Listener:
        """Return a new listener."""
        return Listener(self._env)

    def _render_product(self, camera: Any, resolution: tuple[int, int], **kwargs: Any) -> str:
        path, size = relative(str(camera)), (int(resolution[0]), int(resolution[1]))
        if self._path and (path, size) != (self._path, self._resolution):
            raise TaskError(f"{user_location()}a task has one camera, and this is a second one: '{path}'")
        self._path, self._resolution = path, size
        return str(camera)

    def _annotator(self, name: str, *args: Any, **kwargs: Any) -> Any:
        hint = "rlcli's cameras render rgb, depth and distance, for tasks in its own format"
        raise TaskError(f"{user_location()}the annotator '{name}' has no counterpart", hint=hint)

    def add_to(self, scene: Scene) -> None:
        """Add the camera to the scene, if the task has created a render product.

        Raises:
            TaskError: if the task has no camera at the path.
        """
        if not self._path:
            return
        width, height = self._resolution
        prim = self._env.stage.GetPrimAtPath(f"/World/envs/env_0/{self._path}")
        if prim.kind != "Camera":
            raise TaskError(f"the task has no camera at '{prim.prim_path}'", hint="define it with stage.DefinePrim")
        pos, rotation = _pose(prim)
        if rotation[2, 1] <= 0.0 or abs(rotation[2, 0]) > 1e-3:
            prim.stage.note_ignored(
                f"roll of {prim.prim_path}", "up in the image is the z axis of the world", lost=True
            )
        focal, aperture = (
            _number(prim, n, d) for n, d in (("focalLength", _FOCAL_LENGTH), ("horizontalAperture", _APERTURE))
        )
        near, far = _value(prim, "clippingRange", (0.01, 1e3))
        eye, lookat = pos, pos - rotation[:, 2]  # a USD camera looks along its -z axis
        config = CameraSensorConfig(
            kind="camera", width=width, height=height, eye=tuple(eye.tolist()), lookat=tuple(lookat.tolist()),
            fov=math.degrees(2.0 * math.atan(0.5 * aperture * height / width / focal)), clip=(float(near), float(far)),
        )  # fmt: skip
        scene.sensors[SENSOR] = SensorBuilder(scene.spec, scene.config.entities, scene.ground).add(SENSOR, config)


class Writer(Counterpart):
    """Replicator's PytorchWriter. The listener reads the camera itself."""

    def initialize(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing."""

    attach = initialize


class Listener(Counterpart):
    """Replicator's PytorchListener."""

    def __init__(self, env: OigeEnv) -> None:
        self._env = env

    def get_rgb_data(self) -> Tensor:
        """Return the images of the current state, 0 to 255. (num_envs, 3, height, width) uint8"""
        camera = self._env.sensors[SENSOR]
        assert isinstance(camera, CameraSensor)
        return camera.image.permute(0, 3, 1, 2).to(self._env.device)


def _pose(prim: Prim) -> tuple[np.ndarray, np.ndarray]:
    """Return position and rotation matrix of a prim in its environment, from the transforms that the task has set."""
    pos, rotation = np.zeros(3), np.eye(3)
    path = prim.prim_path
    while path.count("/") > 3:  # below /World/envs/env_0
        part = prim.stage.GetPrimAtPath(path)
        local = _rotation_xyz(_value(part, "xformOp:rotateXYZ", (0.0, 0.0, 0.0)))
        shift = np.asarray(_value(part, "xformOp:translate", part.owner.pos), dtype=float)
        pos, rotation = shift + local @ pos, local @ rotation
        path = path.rpartition("/")[0]
    return pos, rotation


def _rotation_xyz(degrees: Any) -> np.ndarray:
    """Return the matrix of rotations around x, then y, then z."""
    matrix = np.eye(3)
    for axis, angle in enumerate(np.radians(np.asarray(degrees, dtype=float))):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        turn = np.eye(3)
        turn[first, first] = turn[second, second] = math.cos(angle)
        turn[first, second], turn[second, first] = -math.sin(angle), math.sin(angle)
        matrix = turn @ matrix
    return matrix


def _value(prim: Prim, name: str, default: Any) -> Any:
    attribute = prim.attributes.get(("", "", name))
    return default if attribute is None or attribute.value is None else attribute.value


def _number(prim: Prim, name: str, default: float) -> float:
    return float(_value(prim, name, default))

"""Cameras of tasks with image observations: the parts of Omniverse's replicator that such tasks use."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from rlcli.config.schema import CameraSensorConfig
from rlcli.errors import TaskError
from rlcli.scene.camera import CameraSensor
from rlcli.scene.scene import Scene
from rlcli.scene.sensor_builder import SensorBuilder
from rlcli_oige.prim_paths import BASE
from rlcli_oige.stage import get_current_stage, note_ignored
from rlcli_oige.task_yaml import relative
from rlcli_oige.user_code import Counterpart, user_location

if TYPE_CHECKING:
    from rlcli_oige.env import OigeEnv
    from rlcli_oige.stage import Prim

SENSOR, SEGMENTATION = "oige_camera", "oige_segmentation"
"""Names of the camera sensors in the scene: colours, and ids of bodies."""
_BACKGROUND, _UNLABELLED, _FIRST_LABELLED = range(3)
"""Pixel values of an instance-segmentation image: background, objects without a label, first labelled object."""
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
        self._has_segmentation = False
        self.orchestrator = SimpleNamespace(_orchestrator=SimpleNamespace(_is_started=False))
        self.create = SimpleNamespace(render_product=self._render_product)
        self.WriterRegistry = SimpleNamespace(get=lambda name: Writer())
        self.AnnotatorRegistry = SimpleNamespace(get_annotator=self._annotator)

    def listener(self, *args: Any, **kwargs: Any) -> Listener:
        """Return a new `Listener`, from which the task gets the images of its camera."""
        return Listener(self._env)

    def _render_product(self, camera: Any, resolution: tuple[int, int], **kwargs: Any) -> str:
        path, size = relative(str(camera)), (int(resolution[0]), int(resolution[1]))
        if self._path and (path, size) != (self._path, self._resolution):
            raise TaskError(f"{user_location()}'{path}' is a second camera; rlcli has one per task: remove it")
        self._path, self._resolution = path, size
        return str(camera)

    def _annotator(self, name: str, *args: Any, **kwargs: Any) -> Any:
        if name != "instance_segmentation":
            hint = "use rgb images or instance_segmentation; tasks in rlcli's own format also have depth"
            raise TaskError(f"{user_location()}the annotator '{name}' has no counterpart in rlcli", hint=hint)
        self._has_segmentation = True
        return Annotator(self._env)

    def add_to(self, scene: Scene) -> None:
        """Add the camera to the scene, if the task has created a render product.

        Raises:
            TaskError: if the task has no camera at the path.
        """
        if not self._path:
            return
        prim = self._env.stage.GetPrimAtPath(f"/World/envs/env_0/{self._path}")
        placed = _of_stage(prim, *self._resolution) if prim.kind == "Camera" else _of_model(prim)
        near, far = _value(prim, "clippingRange", (0.01, 1e3))
        kinds: dict[str, Any] = {SENSOR: "rgb", **({SEGMENTATION: "segmentation"} if self._has_segmentation else {})}
        width, height = self._resolution
        for name, kind in kinds.items():
            config = CameraSensorConfig(
                kind="camera", data=kind, width=width, height=height, clip=(float(near), float(far)), **placed
            )
            scene.sensors[name] = SensorBuilder(scene.spec, scene.config.entities, scene.ground).add(name, config)


def _of_model(prim: Prim) -> dict[str, Any]:
    """Return the settings (entity and camera) of a camera that is in a robot's MJCF.

    Raises:
        TaskError: if the model has no camera of the name.
    """
    name = prim.GetName()
    model = prim.owner.child
    if model is None or name not in [camera.name for camera in model.cameras]:
        hint = f'add <camera name="{name}"/> to the MJCF of the robot, or define it with stage.DefinePrim'
        raise TaskError(f"the task has no camera at '{prim.prim_path}'", hint=hint)
    return {"entity": prim.owner.entity, "camera": name}


def _of_stage(prim: Prim, width: int, height: int) -> dict[str, Any]:
    """Return the settings (eye, lookat and fov) of a camera that the task has defined on the stage."""
    pos, rotation = _pose(prim)
    if rotation[2, 1] <= 0.0 or abs(rotation[2, 0]) > 1e-3:
        prim.stage.note_ignored(f"roll of {prim.prim_path}", "up in the image is the z axis of the world", lost=True)
    focal, aperture = (
        _number(prim, n, d) for n, d in (("focalLength", _FOCAL_LENGTH), ("horizontalAperture", _APERTURE))
    )
    eye, lookat = pos, pos - rotation[:, 2]  # a USD camera looks along its -z axis
    fov = math.degrees(2.0 * math.atan(0.5 * aperture * height / width / focal))
    return {"eye": tuple(eye.tolist()), "lookat": tuple(lookat.tolist()), "fov": fov}


def add_update_semantics(prim: Any, semantic_label: str, type_label: str = "class", suffix: str = "") -> None:
    """Give a prim (an object of the scene) a semantic label, so that instance segmentation shows it separately."""
    get_current_stage().labelled.add(relative(prim.GetPath()))


class Camera(Counterpart):
    """`omni.isaac.sensor.Camera`: stores the task's settings of a camera that the robot's MJCF already has."""

    def __init__(self, prim_path: str, *args: Any, **kwargs: Any) -> None:
        self.prim_path = prim_path
        self._prim = get_current_stage().GetPrimAtPath(prim_path)
        self._focal_length = _FOCAL_LENGTH / 10.0

    def set_clipping_range(self, near_distance: float | None = None, far_distance: float | None = None) -> None:
        """Set the smallest and the largest distance of objects that the camera renders [m]; None: unchanged."""
        near, far = self.get_clipping_range()
        given = (near if near_distance is None else near_distance, far if far_distance is None else far_distance)
        self._prim.GetAttribute("clippingRange").value = given

    def get_clipping_range(self) -> tuple[float, float]:
        """Return the smallest and the largest distance of objects that the camera renders [m]."""
        near, far = _value(self._prim, "clippingRange", (0.01, 1e3))
        return float(near), float(far)

    def set_focal_length(self, value: float) -> None:
        """Record that the call has no effect, because the camera in the MJCF sets the field of view."""
        self._focal_length = value
        note_ignored("Camera.set_focal_length", "the MJCF's camera has the field of view", lost=True)

    def get_focal_length(self) -> float:
        """Return the focal length [cm]."""
        return self._focal_length


class Annotator(Counterpart):
    """Annotator of instance segmentation, as in Replicator, for the camera of one environment."""

    def __init__(self, env: OigeEnv) -> None:
        self._env = env
        self._row = 0
        self._id_of: Tensor | None = None

    def attach(self, render_products: Any, **kwargs: Any) -> None:
        """Choose the environment whose camera `get_data` reads, from the path of the first render product (camera)."""
        found = re.search(r"/env_(\d+)/", str(render_products[0]))
        self._row = int(found[1]) if found else 0

    def get_data(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Return an image of instance segmentation as a dict.

        Its entry `data` has the number of the visible object for each pixel, (height, width) int32;
        `info.idToLabels` maps each number, as text, to the object's prim path.
        """
        env = self._env
        labelled = {n: p for n, p in enumerate(sorted(env.stage.labelled), _FIRST_LABELLED)}
        if self._id_of is None:  # by body + 1; the first entry: nothing is visible
            self._id_of = torch.full((env.engine.model.nbody + 1,), _UNLABELLED, dtype=torch.int32)
            self._id_of[:2] = _BACKGROUND
            for number, path in labelled.items():
                bodies = env.entities[path.replace("/", "_")].body_ids
                self._id_of[torch.as_tensor(bodies, dtype=torch.int64) + 1] = number
        camera = env.sensors[SEGMENTATION]
        assert isinstance(camera, CameraSensor)
        data = self._id_of[camera.image[self._row, ..., 0].long() + 1]
        visible = set(data.unique().tolist())
        names = {_BACKGROUND: "BACKGROUND", _UNLABELLED: "UNLABELLED"}
        names |= {number: f"{BASE}/env_{self._row}/{path}" for number, path in labelled.items()}
        labels = {str(number): path for number, path in names.items() if number in visible}
        return {"data": data.to(env.device), "info": {"idToLabels": labels}}


warp_int32 = torch.int32


def warp_to_torch(array: Tensor) -> Tensor:
    """Return the data unchanged: an annotator's data are already a torch tensor."""
    return array


class Writer(Counterpart):
    """Replacement for Replicator's PytorchWriter. It does nothing, because the listener reads the camera itself."""

    def initialize(self, *args: Any, **kwargs: Any) -> None:
        """Do nothing."""

    attach = initialize


class Listener(Counterpart):
    """Replacement for Replicator's PytorchListener: it returns the images of a task's camera in all environments."""

    def __init__(self, env: OigeEnv) -> None:
        self._env = env

    def get_rgb_data(self) -> Tensor:
        """Return the images of the task's camera in the current state. (num_envs, 3, height, width) uint8"""
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

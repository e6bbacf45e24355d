"""Sensors and terrain as Isaac Lab's terms expect them: `env.scene["contact_forces"].data.net_forces_w`."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.errors import TaskError, did_you_mean, listing
from rlcli.scene.names import NameProblem, match
from rlcli.sim.rotations import conjugate, multiply, rotate, rotate_inverse
from rlcli_isaaclab.missing_names import absence, user_place
from rlcli_isaaclab.sensor_reader import CAMERA_DATA, image_name
from rlcli_isaaclab.setup_scene import current_setup


class FrameTransformer:
    """Sensor of the poses of frames that are fixed to bodies: a source frame and target frames.

    The names are Isaac Lab's; `data` is the object itself.
    """

    def __init__(self, assets: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
        self.data = self
        self._source = self._bodies(assets, settings["source"])[0]
        self._targets: list[tuple[Any, int, Mapping[str, Any]]] = []
        self.target_frame_names: list[str] = []
        for target in settings["targets"]:
            found = self._bodies(assets, target)
            self._targets += found
            names = [asset.body_names[index] for asset, index, _ in found]
            self.target_frame_names += [target["name"]] * len(found) if target["name"] else names
        self.body_names = self.target_frame_names
        self.joint_names: list[str] = []

    @staticmethod
    def _bodies(assets: Mapping[str, Any], frame: Mapping[str, Any]) -> list[tuple[Any, int, Mapping[str, Any]]]:
        asset = assets[frame["entity"]]
        wanted = frame["body"]
        ids = [0] if wanted is None else asset.find_bodies(wanted)[0]
        return [(asset, index, frame) for index in ids]

    @staticmethod
    def _pose(frame: tuple[Any, int, Mapping[str, Any]]) -> tuple[Tensor, Tensor]:
        asset, index, settings = frame
        pos, quat = asset.data.body_pos_w[:, index], asset.data.body_quat_w[:, index]
        offset = torch.tensor(settings["pos"], device=pos.device).expand_as(pos)
        turn = torch.tensor(settings["rot"], device=pos.device).expand_as(quat)
        return pos + rotate(quat, offset), multiply(quat, turn)

    @property
    def source_pos_w(self) -> Tensor:
        """Position of the source frame, world frame. (num_envs, 3) [m]"""
        return self._pose(self._source)[0]

    @property
    def source_quat_w(self) -> Tensor:
        """Orientation of the source frame (w, x, y, z), world frame. (num_envs, 4)"""
        return self._pose(self._source)[1]

    @property
    def target_pos_w(self) -> Tensor:
        """Positions of the target frames, world frame. (num_envs, frames, 3) [m]"""
        return torch.stack([self._pose(target)[0] for target in self._targets], dim=1)

    @property
    def target_quat_w(self) -> Tensor:
        """Orientations of the target frames (w, x, y, z), world frame. (num_envs, frames, 4)"""
        return torch.stack([self._pose(target)[1] for target in self._targets], dim=1)

    @property
    def target_pos_source(self) -> Tensor:
        """Positions of the target frames in the source frame. (num_envs, frames, 3) [m]"""
        pos, quat = self._pose(self._source)
        return torch.stack([rotate_inverse(quat, self._pose(t)[0] - pos) for t in self._targets], dim=1)

    @property
    def target_quat_source(self) -> Tensor:
        """Orientations of the target frames (w, x, y, z) in the source frame. (num_envs, frames, 4)"""
        back = conjugate(self._pose(self._source)[1])
        return torch.stack([multiply(back, self._pose(t)[1]) for t in self._targets], dim=1)


class CameraView:
    """Camera with the attributes of Isaac Lab's cameras; `data` is the object itself."""

    def __init__(self, cfg: Any) -> None:
        current_setup().add(self, cfg)

    cfg: Any

    def bind(self, *sensors: Any) -> None:
        """Connect the camera with its sensors in the simulation: one for each kind of image (rgb, depth, distance)."""
        self._sensor, self.data = sensors[0], self
        self._images = _Images({name: sensor for sensor in sensors for name in _IMAGE_NAMES[sensor.config.data]})
        self.body_names: list[str] = []
        self.joint_names: list[str] = []

    @property
    def output(self) -> Mapping[str, Tensor]:
        """Images by Isaac Lab's type of image, such as `rgb`. (num_envs, height, width, channels) each"""
        return self._images

    @property
    def image_shape(self) -> tuple[int, int]:
        """Height and width [pixels]."""
        return self._sensor.config.height, self._sensor.config.width


_IMAGE_NAMES = {"rgb": ("rgb",), "depth": ("depth", "distance_to_image_plane"), "distance": ("distance_to_camera",)}
"""The setting `data` of a camera in rlcli -> Isaac Lab's types of images with this content."""


class _Images(Mapping[str, Tensor]):
    """Images of a camera by Isaac Lab's type, such as `rgb`, rendered when they are read.

    Reading a type that the camera does not have raises an error with the types that it has.
    """

    def __init__(self, sensors: Mapping[str, Any]) -> None:
        self._sensors = sensors

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._sensors:
            what, has = f"Camera.data.output[{name!r}]", f"the camera has {listing(self._sensors)}"
            if name in CAMERA_DATA:
                message = f"{user_place()}{what}: the camera renders no such images"
                raise TaskError(message, hint=f"{has}; add {name!r} to its data_types")
            raise absence(what, f"{has}; segmentation and normals have no counterpart")
        image: Tensor = self._sensors[name].image
        return image

    def __contains__(self, name: object) -> bool:
        return name in self._sensors

    def __iter__(self) -> Iterator[str]:
        return iter(self._sensors)

    def __len__(self) -> int:
        return len(self._sensors)


class TerrainImporter:
    """Terrain with the attributes of Isaac Lab's `TerrainImporter`."""

    def __init__(self, cfg: Any) -> None:
        current_setup().add(self, cfg)

    def bind(self, env: VecEnv, terrain: Any) -> None:
        """Connect the object with the terrain of the environment; None: the ground is a plane."""
        self._env, self._terrain = env, terrain

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._terrain, name)

    @functools.cached_property
    def cfg(self) -> Any:
        """Configuration of the terrain in Isaac Lab's form, with the members that terms of its tasks read."""
        config: Any = self._env.config.scene.terrain
        return SimpleNamespace(terrain_type="generator", terrain_generator=SimpleNamespace(
            size=tuple(config.patch), num_rows=self._terrain.rows, num_cols=self._terrain.origins.shape[1],
            curriculum=config.curriculum,
        ))  # fmt: skip

    @property
    def terrain_levels(self) -> Tensor:
        """Terrain level (row of the terrain) of each environment. (num_envs,) int64"""
        return self._terrain.levels

    @property
    def terrain_types(self) -> Tensor:
        """Column of the terrain on which each environment is. (num_envs,) int64"""
        return self._terrain.types

    @property
    def terrain_origins(self) -> Tensor:
        """Start positions on the sub-terrains, by level (row) and column, world frame. (rows, columns, 3) [m]"""
        return self._terrain.origins

    @property
    def env_origins(self) -> Tensor:
        """Start position of each environment, world frame. (num_envs, 3) [m]"""
        return self._env.origins

    def update_env_origins(self, env_ids: Any, move_up: Tensor, move_down: Tensor) -> None:
        """Move environments a level up or down the terrain.

        Args:
            env_ids: not used: the environments are those for which the curriculum term is called.
            move_up: whether to move each of them to the next level. (rows,)
            move_down: whether to move each of them to the previous level. (rows,)
        """
        from rlcli_isaaclab.runtime import facade_of

        selection = facade_of(self._env).selection
        self._terrain.move(selection, move_up.bool(), move_down.bool())


def camera_or_sensor(name: str, sensors: Mapping[str, Any]) -> Any:
    """Return a sensor of the simulation with Isaac Lab's attributes: a `CameraView`, or for another kind a `Sensor`."""
    is_camera = _kind(sensors[name]) == "camera"
    return bound(CameraView if is_camera else Sensor, *bound_parts(name, sensors))


def bound_parts(name: str, sensors: Mapping[str, Any]) -> list[Any]:
    """Return the sensors of the simulation that belong to one sensor of Isaac Lab.

    A camera has one for each kind of image; any other sensor has one.
    """
    more = [image_name(name, kind) for kind in _IMAGE_NAMES] if _kind(sensors[name]) == "camera" else []
    return [sensors[key] for key in (name, *more) if key in sensors]


def _kind(sensor: Any) -> str:
    return str(getattr(getattr(sensor, "config", None), "kind", ""))


def bound(kind: Any, *parts: Any) -> Any:
    """Create an object of the class `kind` without calling `__init__`, and pass `parts` to its method `bind`."""
    made = kind.__new__(kind)
    made.bind(*parts)
    return made


class Sensor:
    """Contact or ray sensor with the attributes of Isaac Lab's sensors; `data` is the object itself."""

    _NAMES = {  # noqa: RUF012  (constant)
        "net_forces_w": "force",
        "net_forces_w_history": "force_history",
        "current_air_time": "air_time",
        "current_contact_time": "contact_time",
        "pos_w": "position",
    }

    def __init__(self, cfg: Any) -> None:
        current_setup().add(self, cfg)

    cfg: Any
    filters: list[Sensor]
    """One sensor for each entry of `filter_prim_paths_expr`: contacts with only these bodies."""

    @property
    def force_matrix_w(self) -> Tensor | None:
        """Contact force on each body from each entry of `filter_prim_paths_expr`, world frame; None without entries.

        Shape: (num_envs, bodies, entries, 3) [N].
        """
        return torch.stack([part._sensor.force for part in self.filters], dim=2) if self.filters else None

    def bind(self, sensor: Any) -> None:
        """Connect the object with a sensor of the simulation."""
        self._sensor = sensor
        self.data = self
        self.body_names = list(getattr(sensor, "names", []))
        self.joint_names: list[str] = []

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        try:
            return getattr(self._sensor, self._NAMES.get(name, name))
        except AttributeError:
            known = sorted({n for n in (*dir(type(self)), *dir(self._sensor), *self._NAMES) if not n.startswith("_")})
            hint = did_you_mean(name, known) or f"its attributes: {listing(known, 40)}"
            raise AttributeError(f"{user_place()}a sensor of rlcli has no '{name}'; {hint}") from None

    @property
    def ray_hits_w(self) -> Tensor:
        """End points of the rays, world frame, contiguous as in Isaac Lab. (num_envs, rays, 3) [m]"""
        return self._sensor.hits.contiguous()

    @property
    def quat_w(self) -> Tensor:
        """Orientation of the body that carries the rays (w, x, y, z), world frame. (num_envs, 4)"""
        quat: Tensor = self._sensor._pose()[1]
        return quat

    @property
    def num_rays(self) -> int:
        """Number of rays."""
        return len(self._sensor._starts)

    @property
    def ray_starts(self) -> Tensor:
        """Starts of the rays in the sensor's body frame. (num_envs, rays, 3) [m]"""
        starts = self._sensor._starts + self._sensor._offset
        return starts.expand(len(self._sensor._position), -1, -1)

    @property
    def ray_directions(self) -> Tensor:
        """Directions of the rays in the sensor's body frame. (num_envs, rays, 3)"""
        return self._sensor._directions.expand(len(self._sensor._position), -1, -1)

    def find_bodies(self, name_keys: Any, preserve_order: bool = False) -> Any:
        """Return (indices, names) of the sensor's bodies whose names match `name_keys`, names or regexes."""
        return find_elements(name_keys, self.body_names, self.body_names, "body", preserve_order)

    def compute_first_contact(self, dt: float, abs_tol: float = 1e-8) -> Tensor:
        """Return for each body whether a contact began in this step; the arguments are not used. (n, bodies) bool"""
        return self._sensor.first_contact

    def compute_first_air(self, dt: float, abs_tol: float = 1e-8) -> Tensor:
        """Return for each body whether its contact ended in this step; the arguments are not used. (n, bodies) bool"""
        return self._sensor.first_air


def find_elements(
    wanted: Any, candidates: Any, names: list[str], kind: str, preserve_order: bool
) -> tuple[list[int], list[str]]:
    """Return the candidates that names or regexes in `wanted` match.

    Args:
        wanted: a name or regex, or a list of them.
        candidates: the names that may be selected, a part of `names`.
        names: all names.
        kind: the kind of element, such as "joint", for the message of the error.
        preserve_order: whether the order of `wanted` is kept; otherwise the order of `names`.

    Returns:
        Indices into `names`, and the selected names.
    """
    try:
        indices = [names.index(candidates[i]) for i in match(wanted, list(candidates), kind)]
    except NameProblem as problem:
        raise NameProblem(f"{user_place()}{problem}", problem.hint) from None
    indices = indices if preserve_order else sorted(indices)
    return indices, [names[i] for i in indices]

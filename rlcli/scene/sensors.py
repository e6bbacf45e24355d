"""Contact sensors and ray sensors of a scene, whose readings are tensors with one row for each environment.

Terms find a sensor by its name in the section `scene.sensors`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from rlcli.config.schema import GridPatternConfig, RaySensorConfig
from rlcli.errors import TaskError
from rlcli.scene.camera import CameraSensor, make_cameras
from rlcli.scene.entity import Entity
from rlcli.scene.height_lookup import HeightTable
from rlcli.scene.lazy_sensor import LazySensor
from rlcli.scene.sensor_builder import CameraSensorSpec, ContactSensorSpec, RaySensorSpec, SensorSpec
from rlcli.sim.acceleration_fields import sensor_columns
from rlcli.sim.column_views import as_index
from rlcli.sim.env_selection import Selection
from rlcli.sim.rotations import rotate
from rlcli.sim.saved_tensors import TensorState
from rlcli.sim.state_cache import SimData

_TIMES = ("air_time", "contact_time", "last_air_time", "last_contact_time")
_FLAGS = ("first_contact", "first_air", "found")
_STATE_NAMES = (*_TIMES, *_FLAGS, "force_history")
"""Attributes of a contact sensor that are saved in a checkpoint."""


class ContactSensor(TensorState):
    """Net contact forces on k bodies, and how long each body has been in contact or in the air.

    Times are in seconds, multiples of the environment step. The step in which contact begins counts as the last of the
    air time and as the first of the contact time. All times are 0 at the start of an episode, so that the first step of
    an episode sets neither `first_contact` nor `first_air`.
    """

    def __init__(self, spec: ContactSensorSpec, sim: SimData) -> None:
        self._sim = sim
        engine = sim.engine
        n, k, device = engine.num_envs, len(spec.bodies), engine.device
        self.names = spec.bodies
        """Names of the sensor's k bodies."""
        self._threshold = spec.config.force_threshold
        self._others = len(spec.sensors[0])
        sensors = [engine.model.sensor(name).id for names in spec.sensors for name in names]
        self._columns = as_index(sensor_columns(engine.model, sensors), device)
        engine.field("sensordata")
        self._times = torch.zeros(n, len(_TIMES), k, device=device)
        self._flags = torch.zeros(n, len(_FLAGS), k, dtype=torch.bool, device=device)
        times, flags = self._times.unbind(1), self._flags.unbind(1)
        self._running_times = self._times[:, :2]
        self.force_history = torch.zeros(n, spec.config.history, k, 3, device=device)
        """Net contact force on each body over the last steps, newest first, world frame. (num_envs, h, k, 3) [N]"""
        self.force = self.force_history[:, 0]
        """Net contact force on each body in the last physics step, world frame. (num_envs, k, 3) [N]"""
        self.air_time = times[0]
        """Time for which each body has been in the air; 0 in contact. (num_envs, k) [s]"""
        self.contact_time = times[1]
        """Time for which each body has been in contact; 0 in the air. (num_envs, k) [s]"""
        self.last_air_time = times[2]
        """Time that each body was in the air before its last contact. (num_envs, k) [s]"""
        self.last_contact_time = times[3]
        """Time that each body was in contact before it last lifted off. (num_envs, k) [s]"""
        self.first_contact = flags[0]
        """Whether contact began in the last step. (num_envs, k)"""
        self.first_air = flags[1]
        """Whether contact ended in the last step. (num_envs, k)"""
        self.found = flags[2]
        """Whether each body is in contact. (num_envs, k)"""

    def update(self, dt: float) -> None:
        """Read the contact forces, and update the times, after an environment step of `dt` seconds."""
        for age in range(self.force_history.shape[1] - 1, 0, -1):
            self.force_history[:, age] = self.force_history[:, age - 1]
        force, found = self._measure(self._sim.derived_field("sensordata"))
        self.force.copy_(force)
        self.found.copy_(found)
        in_air = ~found
        torch.logical_and(found, self.air_time, out=self.first_contact)  # a time other than 0 counts as true
        torch.logical_and(in_air, self.contact_time, out=self.first_air)
        self._running_times.add_(dt)
        torch.where(self.first_contact, self.air_time, self.last_air_time, out=self.last_air_time)
        torch.where(self.first_air, self.contact_time, self.last_contact_time, out=self.last_contact_time)
        self.air_time *= in_air
        self.contact_time *= found

    def reset(self, selection: Selection) -> None:
        """Clear times and history of the selected environments, in which episodes start.

        With `sim.forces_after_reset`, forces of the start state are read.
        """
        for values in (self._times, self._flags, self.force_history):
            selection.write(values, 0)
        if self._sim.engine.forces_after_reset:
            force, found = self._measure(selection.read_view(self._sim.derived_field("sensordata")))
            selection.write(self.force, force)
            selection.write(self.found, found)

    def on_moved(self, selection: Selection) -> None:
        """Do nothing: the forces stay those of the last step, even if an event has moved the bodies since then."""

    def close(self) -> None:
        """Do nothing: the sensor holds no resources."""

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that are saved in a checkpoint, by name."""
        return {name: getattr(self, name) for name in _STATE_NAMES}

    def _measure(self, sensordata: Tensor) -> tuple[Tensor, Tensor]:
        """Return the net force on each body (rows, k, 3), and whether the body is in contact (rows, k).

        `sensordata` has the readings of all MJCF sensors. (rows, nsensordata)
        """
        # a reading is the number of contacts, then the force
        values = torch.unflatten(sensordata[:, self._columns], 1, (-1, self._others, 4))
        total = values[:, :, 0]
        for other in range(1, self._others):
            total = total + values[:, :, other]
        force, found = total[..., 1:], total[..., 0] > 0.0
        if self._threshold > 0.0:
            x, y, z = force.unbind(-1)
            found = found & ((x * x + y * y + z * z).sqrt() >= self._threshold)
        return force, found


class RaySensor(LazySensor):
    """Distances along r rays from a body. The rays are cast when a value is read, at most once per step."""

    def __init__(self, spec: RaySensorSpec, sim: SimData, entity: Entity) -> None:
        super().__init__()
        self._sim = sim
        self._config = config = spec.config
        self._engine = engine = sim.engine
        self._body = engine.model.body(spec.body).id
        self._groups = spec.groups
        self._table = None if spec.ground is None else HeightTable(spec.ground, engine.device)
        self._root = entity.root_qpos if self._body == entity.root_body else None
        self._starts, self._directions = (values.to(engine.device) for values in _pattern(config))
        self._offset = torch.tensor([config.offset], device=engine.device)
        self._unit = torch.eye(3, device=engine.device)
        n, r = engine.num_envs, len(self._starts)
        self.names = [f"ray_{i}" for i in range(r)]
        """Names of the sensor's r rays."""
        self._distance = torch.zeros(n, r, device=engine.device)
        self._missed = torch.zeros(n, r, dtype=torch.bool, device=engine.device)
        # x, y and z of the hits are stored separately, because terms read all heights at once
        planes = torch.zeros(3, n, r, device=engine.device)
        self._hits = planes.movedim(0, 2)
        self._position = torch.zeros(n, 3, device=engine.device)
        self._buffers = (self._distance, self._missed, self._position, *planes.unbind(0))

    @property
    def distance(self) -> Tensor:
        """Distance along each ray to the first hit; `max_distance` without a hit. (num_envs, r) [m]"""
        self._cast()
        return self._distance

    @property
    def missed(self) -> Tensor:
        """Whether each ray hits nothing within `max_distance`. (num_envs, r)"""
        self._cast()
        return self._missed

    @property
    def hits(self) -> Tensor:
        """End point of each ray, world frame. (num_envs, r, 3) [m]"""
        self._cast()
        return self._hits

    @property
    def position(self) -> Tensor:
        """Position of the sensor, world frame. (num_envs, 3) [m]"""
        self._cast()
        return self._position

    def mirror_partners(self) -> list[int]:
        """Return the index of each ray's mirror image about the x-z plane of the sensor.

        Raises:
            TaskError: for a ray without a mirror image.
        """
        rays = torch.cat([self._starts, self._directions], dim=1).cpu()
        images = rays * torch.tensor([1.0, -1.0, 1.0]).repeat(2)
        distances, partners = (images[:, None] - rays).abs().amax(dim=2).min(dim=1)
        if float(distances.max()) > 1e-4:
            ray, body = int(distances.argmax()), self._config.body
            message = f"ray {ray} of the ray sensor on body '{body}' has no mirror image"
            hint = "make the sensor's pattern symmetric about the x-z plane, or set symmetry: null for the agent"
            raise TaskError(message, hint=hint)
        found: list[int] = partners.tolist()
        return found

    def on_moved(self, selection: Selection) -> None:
        """Cast again the rays of environments whose bodies were moved, if rays have been cast in this step."""
        if not self._current:
            return
        position, quat = self._pose()
        found = self._rays(selection.read_view(position), selection.read_view(quat), selection)
        for buffer, values in zip(self._buffers, found, strict=True):
            selection.write(buffer, values)

    def _cast(self) -> None:
        if not self._current:
            self._current = True
            for buffer, values in zip(self._buffers, self._rays(*self._pose()), strict=True):
                buffer.copy_(values)

    def _rays(self, position: Tensor, quat: Tensor, selection: Selection | None = None) -> tuple[Tensor, ...]:
        """Cast the rays from poses of the sensor's body.

        Return the new values of `_buffers`: distances (rows, r), misses (rows, r), positions of the sensor (rows, 3),
        and x, y and z of the end points (rows, r).

        Args:
            position: position of the body, world frame. (rows, 3) [m]
            quat: orientation of the body. (rows, 4)
            selection: environments of the rows; None: all.
        """
        self._sim.forward_moved()
        axes = self._axes(quat)
        position = position + _rotated(axes, self._offset)[:, 0]
        max_distance = self._config.max_distance
        if self._table is not None:
            x, y, z = self._down_from(position, axes)
            distance, on_ground = self._table.depth(x, y, z)
            missed = ((distance >= 0.0) & (distance <= max_distance) & on_ground).logical_not_()
            distance.masked_fill_(missed, max_distance)
            return distance, missed, position, x, y, z - distance
        points = position[:, None] + _rotated(axes, self._starts)
        directions = _rotated(axes, self._directions)
        found = self._engine.rays(points, directions, groups=self._groups, exclude=self._body, selection=selection)
        missed = (found < 0.0) | (found > max_distance)
        distance = found.masked_fill_(missed, max_distance)
        return distance, missed, position, *(points + directions * distance[..., None]).unbind(2)

    def _down_from(self, position: Tensor, axes: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return x and y of the start points of rays straight down, (rows, r) each, and their z, (rows, 1) [m].

        `position` is the position of the sensor, world frame (rows, 3) [m]; for `axes` see `_axes`.
        """
        ahead, left, _ = self._starts.unbind(1)
        x, y, z = position[:, None].unbind(2)
        if axes is None:
            return x + ahead, y + left, z
        (cos, sin, _), (across_x, across_y, _) = (axis[:, None].unbind(2) for axis in axes.unbind(1)[:2])
        turned_x = (ahead * cos).add_(left * across_x)
        turned_y = (ahead * sin).add_(left * across_y)
        return turned_x.add_(x), turned_y.add_(y), z

    def _pose(self) -> tuple[Tensor, Tensor]:
        """Return position (num_envs, 3) [m] and quaternion (num_envs, 4) of the sensor's body, world frame."""
        if self._root is not None:
            qpos = self._sim.qpos
            return qpos[:, self._root : self._root + 3], qpos[:, self._root + 3 : self._root + 7]
        return self._sim.derived_field("xpos")[:, self._body], self._sim.derived_field("xquat")[:, self._body]

    def _axes(self, quat: Tensor) -> Tensor | None:
        """Return the axes of the sensor's frame in the world, from the orientation of its body. (rows, 3, 3)

        The axes are the rows of a matrix for each environment; None: the axes are those of the world.
        """
        if self._config.alignment == "world":
            return None
        x, y, z = (rotate(quat, axis.expand(len(quat), 3)) for axis in self._unit)
        if self._config.alignment == "base":
            return torch.stack([x, y, z], dim=1)
        ahead, left = x[:, 0] + 1e-12, x[:, 1]  # 1e-12 makes the yaw 0 for a body whose x axis is vertical
        norm = (ahead * ahead + left * left).sqrt()
        cos, sin, zero = ahead / norm, left / norm, torch.zeros_like(norm)
        rows = [cos, sin, zero, -sin, cos, zero, zero, zero, zero + 1.0]
        return torch.unflatten(torch.stack(rows, dim=1), 1, (3, 3))


Sensor = ContactSensor | RaySensor | CameraSensor
"""A sensor of `scene.sensors`."""


def make_sensors(specs: Mapping[str, SensorSpec], sim: SimData, entities: Mapping[str, Entity]) -> dict[str, Sensor]:
    """Return the objects that read the sensors of a compiled scene, by name, in the order of `specs`."""
    cameras = {name: spec for name, spec in specs.items() if isinstance(spec, CameraSensorSpec)}
    sensors: dict[str, Sensor] = dict(make_cameras(cameras, sim.engine))
    for name, spec in specs.items():
        if isinstance(spec, ContactSensorSpec):
            sensors[name] = ContactSensor(spec, sim)
        elif isinstance(spec, RaySensorSpec):
            sensors[name] = RaySensor(spec, sim, entities[spec.config.entity])
    return {name: sensors[name] for name in specs}


def _pattern(config: RaySensorConfig) -> tuple[Tensor, Tensor]:
    """Return the start points of the rays relative to the sensor [m], and their unit directions. (r, 3) each"""
    if not isinstance(config.pattern, GridPatternConfig):
        directions = torch.tensor(config.pattern)
        return torch.zeros_like(directions), torch.nn.functional.normalize(directions, dim=1)
    x, y = (_line(size, config.pattern.resolution) for size in config.pattern.size)
    y, x = torch.meshgrid(y, x, indexing="ij")
    starts = torch.stack([x, y, torch.zeros_like(x)], dim=-1).view(-1, 3)
    direction = torch.nn.functional.normalize(torch.tensor(config.pattern.direction), dim=0)
    return starts, direction.expand(len(starts), 3).contiguous()


def _line(size: float, resolution: float) -> Tensor:
    """Return the coordinates of points on a line, centred at 0 [m].

    The distance of the points is `resolution`; as many points as possible lie within the length `size` [m].
    """
    count = math.floor(size / resolution + 1e-6) + 1
    return (torch.arange(count) - (count - 1) / 2) * resolution


def _rotated(axes: Tensor | None, vectors: Tensor) -> Tensor:
    """Rotate vectors from the sensor's frame to the world frame. (r, 3) -> (rows, r, 3)

    `axes` are the sensor's axes in the world, for each environment; None: the world's axes, and the result has one row.
    """
    if axes is None:
        return vectors[None]
    x, y, z = axes[:, None].unbind(2)
    return vectors[:, 0:1] * x + vectors[:, 1:2] * y + vectors[:, 2:3] * z

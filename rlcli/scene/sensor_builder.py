"""Add the sensors of a task to the model of its scene, before the model is compiled.

For each sensor `SensorBuilder` returns a specification, from which `rlcli.scene.sensors` makes the object that reads
the sensor.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from rlcli.config.schema import CameraSensorConfig, ContactSensorConfig, EntityConfig, RaySensorConfig, SensorConfig
from rlcli.errors import did_you_mean, listing
from rlcli.scene.names import NameProblem, SceneProblem, match
from rlcli.scene.terrain import TERRAIN_BODY, Ground

_CONTACT_DATA = mujoco.mjtConDataField
_FOUND_AND_FORCE = (1 << int(_CONTACT_DATA.mjCONDATA_FOUND)) | (1 << int(_CONTACT_DATA.mjCONDATA_FORCE))
_NET_FORCE = 3
"""Value of MuJoCo's contact-sensor option `reduce` with which it adds up all contact forces, in the world frame."""
_DRAWN_GROUPS = (0, 1, 2)
"""Geom groups that viewers show by default."""


@dataclass(frozen=True, slots=True)
class ContactSensorSpec:
    """Specification of a contact sensor that was added to the model."""

    config: ContactSensorConfig
    bodies: list[str]
    """Names of the bodies, without the entity."""
    sensors: list[list[str]]
    """Names of the MJCF sensors of each body, whose forces are added up."""


@dataclass(frozen=True, slots=True)
class RaySensorSpec:
    """Specification of a ray sensor that was added to the model."""

    config: RaySensorConfig
    body: str
    """Full name of the sensor's body, `entity/body`."""
    groups: tuple[int, ...] | None
    """Geom groups that rays can hit; None: all groups."""
    ground: Ground | None = None
    """Terrain in which heights are looked up instead of casting rays; None: cast rays."""


@dataclass(frozen=True, slots=True)
class CameraSensorSpec:
    """Specification of a camera sensor that was added to the model."""

    config: CameraSensorConfig
    camera: str
    """Full name of the camera in the model."""


SensorSpec = ContactSensorSpec | RaySensorSpec | CameraSensorSpec


class SensorBuilder:
    """Builder that adds sensors to the model of a scene, which already has its entities and its ground.

    Args:
        spec: the model.
        entities: configuration of each entity.
        ground: the generated terrain; None: the scene has none.
    """

    def __init__(self, spec: mujoco.MjSpec, entities: Mapping[str, EntityConfig], ground: Ground | None) -> None:
        self._spec = spec
        self._entities = entities
        self._ground = ground

    def add(self, name: str, config: SensorConfig) -> SensorSpec:
        """Add a sensor to the model, and return its specification. `name` is the sensor's name in the task.

        Raises:
            SceneProblem: if the configuration does not fit the models.
        """
        path = ("scene", "sensors", name)
        if isinstance(config, ContactSensorConfig):
            return self._contacts(name, config, path)
        if isinstance(config, CameraSensorConfig):
            return self._camera(name, config, path)
        return self._rays(config, path)

    def _contacts(self, name: str, config: ContactSensorConfig, path: tuple[str, ...]) -> ContactSensorSpec:
        """Add a contact sensor: an MJCF sensor for each pair of a body and an element that may touch it.

        `path` is the sensor's key in the configuration, for messages.
        """
        prefix = f"{config.entity}/"
        bodies = self._bodies(config.entity, config.bodies, path, "bodies")
        if not any(map(self._can_touch, bodies)):
            solid = [body for body in self._bodies(config.entity, ".*", path, "bodies") if self._can_touch(body)]
            allowed = listing([b.removeprefix(prefix) for b in solid]) if solid else "none"
            found = listing([body.removeprefix(prefix) for body in bodies])
            message = f"no geom of {found} can have contacts"
            raise SceneProblem((*path, "bodies"), message, f"bodies whose geoms can have contacts: {allowed}")
        sensors: list[list[str]] = []
        for slot, body in enumerate(bodies):
            sensors.append([])
            for number, other in enumerate(self._contact_partners(config, path)):
                sensor = self._spec.add_sensor(name=f"//{name}/{slot}/{number}", type=mujoco.mjtSensor.mjSENS_CONTACT)
                if other is not None:
                    sensor.objtype, sensor.objname = other
                # the force of a contact sensor acts on the second of its two elements
                sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_BODY, body
                sensor.intprm[:3] = [_FOUND_AND_FORCE, _NET_FORCE, 1]  # data, reduction, number of contacts
                sensors[-1].append(sensor.name)
        return ContactSensorSpec(config, [body.removeprefix(prefix) for body in bodies], sensors)

    def _contact_partners(
        self, config: ContactSensorConfig, path: tuple[str, ...]
    ) -> list[tuple[mujoco.mjtObj, str] | None]:
        """Return (MuJoCo type, name) of the elements whose contacts with the sensor's bodies are measured.

        The list is [None] if contacts with all elements are measured.
        """
        against = config.against
        if against is None:
            return [None]
        if against == "ground":
            if not self._ground_geoms():
                raise SceneProblem((*path, "against"), "the scene has no ground", "add scene.ground or scene.terrain")
            if self._ground is not None:
                return [(mujoco.mjtObj.mjOBJ_BODY, TERRAIN_BODY)]
            return [(mujoco.mjtObj.mjOBJ_GEOM, "ground")]
        path = (*path, "against")
        if against.bodies is not None:
            bodies = self._bodies(against.entity, against.bodies, path, "bodies")
            return [(mujoco.mjtObj.mjOBJ_BODY, body) for body in bodies]
        bodies = self._bodies(against.entity, ".*", path, "bodies")
        roots = [body for body in bodies if not self._spec.body(body).parent.name.startswith(f"{against.entity}/")]
        # an XBODY stands for a body and all its descendants
        return [(mujoco.mjtObj.mjOBJ_XBODY, body) for body in roots]

    def _rays(self, config: RaySensorConfig, path: tuple[str, ...]) -> RaySensorSpec:
        body = self._body(config.entity, config.body, path)
        groups = tuple(config.sees) if isinstance(config.sees, list) else None
        if config.sees == "ground":
            groups = (self._group_of_ground((*path, "sees")),)
        if not config.lookup:
            return RaySensorSpec(config, body, groups)
        if self._ground is None or self._ground.blocks:
            reason = "the scene has no terrain" if self._ground is None else "the terrain has boxes"
            message = f"heights cannot be looked up: {reason}"
            raise SceneProblem((*path, "lookup"), message, "set lookup: false")
        return RaySensorSpec(config, body, groups, self._ground)

    def _camera(self, name: str, config: CameraSensorConfig, path: tuple[str, ...]) -> CameraSensorSpec:
        body = self._spec.worldbody
        if config.entity is not None:
            body = self._spec.body(self._body(config.entity, config.body, path))
        if config.camera is None:
            quat = _look_rotation(np.subtract(config.lookat, config.eye))
            camera = body.add_camera(name=f"//{name}", pos=config.eye, quat=quat, fovy=config.fov)
            return CameraSensorSpec(config, camera.name)
        prefix = f"{config.entity}/"
        names = [c.name.removeprefix(prefix) for c in self._spec.cameras if c.name.startswith(prefix)]
        if config.camera not in names:
            hint = did_you_mean(config.camera, names) or f"cameras: {listing(names) if names else 'none'}"
            raise SceneProblem((*path, "camera"), f"no camera '{config.camera}' in the MJCF of '{config.entity}'", hint)
        return CameraSensorSpec(config, prefix + config.camera)

    def _body(self, entity: str, pattern: str | None, path: tuple[str, ...]) -> str:
        """Return the full name, `entity/body`, of the body that matches a pattern; of the root if `pattern` is None."""
        bodies = self._bodies(entity, ".*" if pattern is None else pattern, path, "body")
        if pattern is not None and len(bodies) > 1:
            short = listing([body.removeprefix(f"{entity}/") for body in bodies])
            raise SceneProblem((*path, "body"), f"'{pattern}' matches several bodies: {short}", "name one body")
        return bodies[0]

    def _bodies(self, entity: str, patterns: str | list[str], path: tuple[str, ...], key: str) -> list[str]:
        """Return the full names, `entity/body`, of the bodies that patterns match.

        `path` is the sensor's key in the configuration, `key` the key of the patterns below it, for messages.
        """
        if entity not in self._entities:
            hint = did_you_mean(entity, self._entities) or f"entities: {listing(self._entities)}"
            raise SceneProblem((*path, "entity"), f"no entity '{entity}' in the scene", hint)
        prefix = f"{entity}/"
        names = [body.name.removeprefix(prefix) for body in self._spec.bodies if body.name.startswith(prefix)]
        try:
            return [prefix + names[position] for position in match(patterns, names, "body")]
        except NameProblem as problem:
            raise SceneProblem((*path, key), str(problem), problem.hint) from None

    def _can_touch(self, body: str) -> bool:
        """Return whether a geom of a body, given by its full name, can have contacts."""
        geoms = self._spec.body(body).geoms
        paired = {name for pair in self._spec.pairs for name in (pair.geomname1, pair.geomname2)}
        return any(geom.contype or geom.conaffinity or (geom.name and geom.name in paired) for geom in geoms)

    def _ground_geoms(self) -> list[mujoco.MjsGeom]:
        if self._ground is not None:
            return list(self._spec.body(TERRAIN_BODY).geoms)
        return [geom for geom in self._spec.worldbody.geoms if geom.name == "ground"]

    def _group_of_ground(self, path: tuple[str, ...]) -> int:
        """Move the ground to a geom group without other geoms, and return the group, by which rays select the ground.

        `path` is the sensor's key in the configuration, for messages.
        """
        ground = self._ground_geoms()
        if not ground:
            raise SceneProblem(path, "the scene has no ground", "add scene.ground or scene.terrain, or write sees: all")
        names = {geom.name for geom in ground}
        used_groups = {int(geom.group) for geom in self._spec.geoms if geom.name not in names}
        free_groups = [group for group in _DRAWN_GROUPS if group not in used_groups]
        if not free_groups:
            message = f"the entities have geoms in all groups that are rendered: {listing(map(str, _DRAWN_GROUPS))}"
            raise SceneProblem(path, message, "leave one group free for the ground in the MJCF, or write sees: all")
        for geom in ground:
            geom.group = free_groups[0]
        return free_groups[0]


def _look_rotation(ray: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the orientation (w, x, y, z) of a camera that looks along a ray, with the world's z axis up.

    A camera looks along its own -z axis. If the ray is parallel to the world's z axis, the world's x axis is up.
    """
    back = -ray / np.linalg.norm(ray)
    right = np.cross([0.0, 0.0, 1.0], back)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross([1.0, 0.0, 0.0], back)
    right /= np.linalg.norm(right)
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.stack([right, np.cross(back, right), back], axis=1).flatten())
    return quat

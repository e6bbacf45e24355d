"""From the scene's configuration to a compiled MuJoCo model: named entities, ground, lights, actuators."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from rlcli.config.schema import (
    CameraSensorConfig,
    ContactSensorConfig,
    EntityConfig,
    JointConfig,
    LightsConfig,
    RaySensorConfig,
    SceneConfig,
    SimConfig,
)
from rlcli.errors import ConfigError, MissingModelError, Problem, TaskError, did_you_mean, listing
from rlcli.registry import model_file
from rlcli.sim.mjcf import BadModel, model_roots, quiet_mujoco, read_mjcf
from rlcli.sim.names import NameProblem, match
from rlcli.sim.terrain import BODY as TERRAIN
from rlcli.sim.terrain import Ground, add_ground, make_ground, misfits

_INTEGRATORS = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
}
_SHAPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "plane": mujoco.mjtGeom.mjGEOM_PLANE,
}
_OPTIONS = (
    "integrator", "cone", "jacobian", "solver", "tolerance", "ls_tolerance", "noslip_tolerance", "iterations",
    "ls_iterations", "noslip_iterations", "ccd_iterations", "ccd_tolerance", "impratio", "density", "viscosity",
    "wind", "magnetic", "disableflags", "enableflags", "disableactuator",
)  # fmt: skip

_FOUND_AND_FORCE = (1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND)) | (
    1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE)
)
_NET_FORCE = 3
"""Of a contact sensor's reductions the one that adds all contacts up, in the world frame."""
_DRAWN_GROUPS = (0, 1, 2)
"""Geom groups that viewers draw."""


@dataclass(frozen=True, slots=True)
class ActuatorNeed:
    """An action term needs an actuator of a kind on some joints of an entity."""

    entity: str
    joints: str | list[str]
    kind: str
    path: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class ContactSlots:
    """A contact sensor in the model: its bodies, and the MJCF sensors of each, whose forces add up."""

    config: ContactSensorConfig
    bodies: list[str]
    sensors: list[list[str]]


@dataclass(frozen=True, slots=True)
class RayMount:
    """A ray sensor in the model: the full name of its body, and the geom groups that it sees (None: all)."""

    config: RaySensorConfig
    body: str
    groups: tuple[int, ...] | None
    ground: Ground | None = None
    """What heights are looked up in, instead of casting rays."""


@dataclass(frozen=True, slots=True)
class CameraMount:
    """A camera sensor in the model: the full name of its camera."""

    config: CameraSensorConfig
    camera: str


class SceneProblem(ValueError):
    """Something in the scene's configuration that the models do not fit; `path` is its key."""

    def __init__(self, path: tuple[str, ...], message: str, hint: str | None = None) -> None:
        super().__init__(message)
        self.path = path
        self.hint = hint


class Scene:
    """A scene under construction; `spec` is open to a direct task's `set_up_scene` until it is compiled."""

    def __init__(self, config: SceneConfig, sim: SimConfig, root: Path, *, installed: bool = False) -> None:
        quiet_mujoco()  # attaching a model whose options differ from the scene's logs each of them
        self.config = config.model_copy(update={"entities": dict(config.entities)})
        self.sim = sim
        self.root = root.resolve()
        self.installed = installed
        self.spec = mujoco.MjSpec()
        self.spec.copy_during_attach = True
        self.problems: list[SceneProblem] = []
        self.views: list[object] = []
        self.sensors: dict[str, ContactSlots | RayMount | CameraMount] = {}
        self.ground: Ground | None = None
        for name, entity in config.entities.items():
            self._attach(name, entity)
        self._options()
        if config.terrain is not None:
            self._terrain()
        elif config.ground is not None:
            self._ground()
        self._lights(config.lights)
        self._sensors()

    def add(self, view):
        """Register a view; it is bound to the simulation once the model is compiled."""
        self.views.append(view)
        return view

    def add_actuators(self, needs: Iterable[ActuatorNeed]) -> None:
        """Add the actuators that are asked for and that the MJCF does not have."""
        for need in needs:
            if need.entity not in self.config.entities:
                continue  # the term's own binding says so
            names = [joint.name.removeprefix(f"{need.entity}/") for joint in self._joints(need.entity)]
            try:
                models = self.config.entities[need.entity].actuators.values()
                modelled = {names[p] for model in models for p in match(model.joints, names, "joint")}
                for position in match(need.joints, names, "joint"):
                    if names[position] not in modelled:
                        self._actuate(need.entity, names[position], need.kind)
            except NameProblem:
                continue  # likewise

    def add_motors(self) -> None:
        """Give every hinge and slide joint without an actuator a motor: a direct task may set any effort."""
        driven = {actuator.target for actuator in self.spec.actuators}
        for entity in self.config.entities:
            for joint in self._joints(entity):
                if joint.name not in driven:
                    self._actuate(entity, joint.name.removeprefix(f"{entity}/"), "motor")

    def compile(self) -> mujoco.MjModel:
        """Compile to an MjModel.

        Raises:
            ConfigError: if MuJoCo refuses the model.
        """
        try:
            with warnings.catch_warnings():
                # attach reports options of the MJCF that the scene's own replace; sim: says which hold
                warnings.simplefilter("ignore")
                model = self.spec.compile()
        except ValueError as error:
            raise ConfigError([Problem("scene", "", f"MuJoCo cannot compile the model: {_one_line(error)}")]) from None
        return model

    def _attach(self, name: str, entity: EntityConfig) -> None:
        child = self._load(name, entity) if entity.model is not None else _shape(entity)
        if child is None:
            return
        self.attach(name, entity, child)

    def attach(self, name: str, entity: EntityConfig, child: mujoco.MjSpec) -> None:
        """Add an entity to the scene; `child` is its model, which `entity.model` need not name."""
        self.config.entities[name] = entity
        name_all(child)
        if child.compiler.settotalmass > 0:
            _settle_masses(child)
        models = [other for other, config in self.config.entities.items() if config.model is not None]
        if name == next(iter(models), None):
            for option in _OPTIONS:
                if hasattr(child.option, option):
                    setattr(self.spec.option, option, getattr(child.option, option))
        for key in list(child.keys):
            child.delete(key)  # keyframes of one entity have the wrong size in a scene of several
        self.spec.memory = max(self.spec.memory, child.memory)
        quat = np.asarray(entity.quat) / np.linalg.norm(entity.quat)
        frame = self.spec.worldbody.add_frame(pos=entity.pos, quat=quat)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self.spec.attach(child, prefix=f"{name}/", frame=frame)
        self._override_joints(name, entity, degrees=bool(child.compiler.degree))
        self._model_actuators(name, entity)

    def _load(self, name: str, entity: EntityConfig) -> mujoco.MjSpec | None:
        """The MJCF of an entity; None if it cannot be read."""
        path = ("scene", "entities", name)
        assert entity.model is not None
        try:
            file = model_file(self.root, entity.model).resolve()
        except MissingModelError:
            raise
        except TaskError as error:
            self.problems.append(SceneProblem((*path, "model"), error.message, error.hint))
            return None
        if ":" not in entity.model and not file.is_relative_to(self.root):
            self.problems.append(
                SceneProblem((*path, "model"), f"'{entity.model}' lies outside the task's folder {self.root}")
            )
            return None
        if not file.is_file():
            have = sorted(str(p.relative_to(self.root)) for p in self.root.rglob("*.xml"))
            self.problems.append(
                SceneProblem(
                    (*path, "model"),
                    f"no file '{entity.model}' in {self.root}",
                    f"MJCF files there: {', '.join(have) or 'none'}",
                )
            )
            return None
        try:
            installed = self.installed or ":" in entity.model
            return read_mjcf(file, model_roots(self.root, entity.model), installed=installed)
        except BadModel as error:
            self.problems.append(
                SceneProblem((*path, "model"), f"'{entity.model}' is not a valid MJCF: {_one_line(error)}")
            )
            return None

    def _override_joints(self, name: str, entity: EntityConfig, *, degrees: bool) -> None:
        joints = self._joints(name)
        names = [joint.name.removeprefix(f"{name}/") for joint in joints]
        for pattern, change in entity.joints.items():
            try:
                positions = match(pattern, names, "joint")
            except NameProblem as problem:
                self.problems.append(
                    SceneProblem(("scene", "entities", name, "joints", pattern), str(problem), problem.hint)
                )
                continue
            for position in positions:
                _override(joints[position], change, degrees=degrees)
                self._tune(joints[position].name, change)
                if change.actuator is not None:
                    self._actuate(name, names[position], change.actuator)

    def _model_actuators(self, name: str, entity: EntityConfig) -> None:
        """Give the joints of actuator models a motor each, without limits of its own, in place of what they have."""
        names = [joint.name.removeprefix(f"{name}/") for joint in self._joints(name)]
        owner: dict[str, str] = {}
        for key, config in entity.actuators.items():
            path = ("scene", "entities", name, "actuators", key)
            try:
                joints = [names[position] for position in match(config.joints, names, "joint")]
            except NameProblem as problem:
                self.problems.append(SceneProblem((*path, "joints"), str(problem), problem.hint))
                continue
            for joint in joints:
                if joint in owner:
                    message = f"joint '{joint}' is driven by '{owner[joint]}' already"
                    self.problems.append(SceneProblem((*path, "joints"), message))
                    continue
                owner[joint] = key
                target = f"{name}/{joint}"
                for actuator in [a for a in self.spec.actuators if a.target == target]:
                    self.spec.delete(actuator)
                motor = self.spec.add_actuator(name=target, target=target, trntype=mujoco.mjtTrn.mjTRN_JOINT)
                motor.set_to_motor()

    def _tune(self, joint: str, change: JointConfig) -> None:
        """Gains and limits of the actuators that the joint has."""
        for actuator in self.spec.actuators:
            if actuator.target != joint or actuator.trntype != mujoco.mjtTrn.mjTRN_JOINT:
                continue
            if change.effort_limit is not None:
                _limit(actuator, change.effort_limit)
            kind = _spec_kind(actuator)
            if kind == "position" and change.kp is not None:
                actuator.gainprm[0], actuator.biasprm[1] = change.kp, -change.kp
            if kind == "velocity" and change.kv is not None:
                actuator.gainprm[0] = change.kv
            if kind in ("position", "velocity") and change.kv is not None:
                actuator.biasprm[2] = -change.kv

    def _actuate(self, entity: str, joint: str, kind: str) -> None:
        target = f"{entity}/{joint}"
        if any(a.target == target and _spec_kind(a) == kind for a in self.spec.actuators):
            return
        settings = joint_settings(self.config.entities[entity], joint)
        taken = {actuator.name for actuator in self.spec.actuators}
        name = target if target not in taken else f"{target}_{kind}"
        actuator = self.spec.add_actuator(name=name, target=target, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        if kind == "motor":
            actuator.set_to_motor()
        elif kind == "position":
            if settings.kp is None:
                self.problems.append(
                    SceneProblem(
                        ("scene", "entities", entity, "joints"),
                        f"joint '{joint}' needs a position actuator and no gain is given",
                        f"add joints: {{{joint}: {{kp: ..., kv: ...}}}}",
                    )
                )
                return
            actuator.set_to_position(kp=settings.kp, kv=settings.kv or 0.0)
        else:
            actuator.set_to_velocity(kv=settings.kv if settings.kv is not None else 1.0)
        if settings.effort_limit is not None:
            _limit(actuator, settings.effort_limit)

    def _joints(self, entity: str) -> list[mujoco.MjsJoint]:
        scalar = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        return [j for j in self.spec.joints if j.name.startswith(f"{entity}/") and j.type in scalar]

    def _options(self) -> None:
        option = self.spec.option
        option.timestep = self.sim.dt
        option.gravity = self.sim.gravity
        if self.sim.integrator is not None:
            option.integrator = _INTEGRATORS[self.sim.integrator]
        if self.sim.iterations is not None:
            option.iterations = self.sim.iterations
        if self.sim.ls_iterations is not None:
            option.ls_iterations = self.sim.ls_iterations

    def _ground(self) -> None:
        ground = self.config.ground
        assert ground is not None
        self._surface()
        self.spec.worldbody.add_geom(
            name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[ground.size / 2, ground.size / 2, 1.0],
            material="ground", friction=[ground.friction, 0.005, 0.0001],
        )  # fmt: skip

    def _terrain(self) -> None:
        config = self.config.terrain
        assert config is not None
        wrong = [SceneProblem(("scene", "terrain", *p), text, hint) for p, text, hint in misfits(config, self.root)]
        self.problems += wrong
        if not wrong:
            self._surface()
            self.ground = make_ground(config, self.root)
            add_ground(self.spec, self.ground, "ground")

    def _surface(self) -> None:
        """What the ground looks like, and the sky."""
        self.spec.add_texture(
            name="ground", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
            rgb1=[0.86, 0.88, 0.90], rgb2=[0.77, 0.79, 0.82], width=512, height=512,
        )  # fmt: skip
        material = self.spec.add_material(name="ground", texrepeat=[1, 1], texuniform=True)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "ground"
        self.spec.add_texture(
            name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
            rgb1=[0.45, 0.63, 0.83], rgb2=[0.86, 0.91, 0.95], width=256, height=1536,
        )  # fmt: skip

    def _lights(self, lights: LightsConfig) -> None:
        headlight = self.spec.visual.headlight
        if lights.dome is not None:
            strength = min(1.0, lights.dome.intensity / 1000.0)
            headlight.ambient = [strength * c for c in lights.dome.color]
            headlight.diffuse = [0.7 * strength * c for c in lights.dome.color]
            headlight.specular = [0.1 * strength] * 3
        if lights.distant is not None:
            strength = min(1.0, lights.distant.intensity / 1000.0)
            self.spec.worldbody.add_light(
                name="distant", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=lights.distant.direction,
                pos=[0, 0, 20], diffuse=[strength * c for c in lights.distant.color], castshadow=True,
            )  # fmt: skip

    def _sensors(self) -> None:
        for name, config in self.config.sensors.items():
            try:
                if isinstance(config, ContactSensorConfig):
                    self.sensors[name] = self._contact_sensor(name, config)
                elif isinstance(config, CameraSensorConfig):
                    self.sensors[name] = self._camera_sensor(name, config)
                else:
                    self.sensors[name] = self._ray_sensor(name, config)
            except SceneProblem as problem:
                self.problems.append(problem)

    def _contact_sensor(self, name: str, config: ContactSensorConfig) -> ContactSlots:
        """For each body and what it may touch, a sensor of the model: net force on the body, and how many contacts.

        The body is the second of the two, which makes the force the one that acts on it.
        """
        path = ("scene", "sensors", name)
        bodies = self._bodies(config.entity, config.bodies, path, "bodies")
        solid = [body for body in self._bodies(config.entity, ".*", path, "bodies") if self._can_touch(body)]
        for body in bodies:
            if not self._can_touch(body):
                have = listing([b.removeprefix(f"{config.entity}/") for b in solid]) if solid else "none"
                short = body.removeprefix(f"{config.entity}/")
                message = f"body '{short}' has no geom that can touch anything"
                raise SceneProblem((*path, "bodies"), message, f"bodies that have: {have}")
        made: list[list[str]] = []
        for slot, body in enumerate(bodies):
            made.append([])
            for number, other in enumerate(self._touched(config, path)):
                sensor = self.spec.add_sensor(name=f"//{name}/{slot}/{number}", type=mujoco.mjtSensor.mjSENS_CONTACT)
                if other is not None:
                    sensor.objtype, sensor.objname = other
                sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_BODY, body
                sensor.intprm[:3] = [_FOUND_AND_FORCE, _NET_FORCE, 1]
                made[-1].append(sensor.name)
        return ContactSlots(config, [body.removeprefix(f"{config.entity}/") for body in bodies], made)

    def _touched(self, config: ContactSensorConfig, path: tuple[str, ...]) -> list[tuple[mujoco.mjtObj, str] | None]:
        against = config.against
        if against is None:
            return [None]
        if against == "ground":
            if not self._ground_geoms():
                raise SceneProblem((*path, "against"), "the scene has no ground", "add scene.ground or scene.terrain")
            if self.ground is not None:
                return [(mujoco.mjtObj.mjOBJ_BODY, TERRAIN)]
            return [(mujoco.mjtObj.mjOBJ_GEOM, "ground")]
        path = (*path, "against")
        if against.bodies is not None:
            bodies = self._bodies(against.entity, against.bodies, path, "bodies")
            return [(mujoco.mjtObj.mjOBJ_BODY, body) for body in bodies]
        every = self._bodies(against.entity, ".*", path, "bodies")
        roots = [body for body in every if not self.spec.body(body).parent.name.startswith(f"{against.entity}/")]
        return [(mujoco.mjtObj.mjOBJ_XBODY, body) for body in roots]

    def _ray_sensor(self, name: str, config: RaySensorConfig) -> RayMount:
        path = ("scene", "sensors", name)
        bodies = self._bodies(config.entity, ".*" if config.body is None else config.body, path, "body")
        if config.body is not None and len(bodies) > 1:
            short = listing([body.removeprefix(f"{config.entity}/") for body in bodies])
            raise SceneProblem((*path, "body"), f"'{config.body}' is several bodies: {short}", "name one")
        groups = tuple(config.sees) if isinstance(config.sees, list) else None
        if config.sees == "ground":
            groups = (self._group_of_ground((*path, "sees")),)
        if not config.lookup:
            return RayMount(config, bodies[0], groups)
        if self.ground is None or self.ground.blocks:
            lacks = "the scene has no terrain" if self.ground is None else "the terrain has boxes"
            raise SceneProblem((*path, "lookup"), f"there is no table of heights to look in: {lacks}", "lookup: false")
        return RayMount(config, bodies[0], groups, self.ground)

    def _camera_sensor(self, name: str, config: CameraSensorConfig) -> CameraMount:
        path = ("scene", "sensors", name)
        body = self.spec.worldbody
        if config.entity is not None:
            bodies = self._bodies(config.entity, ".*" if config.body is None else config.body, path, "body")
            if config.body is not None and len(bodies) > 1:
                short = listing([body.removeprefix(f"{config.entity}/") for body in bodies])
                raise SceneProblem((*path, "body"), f"'{config.body}' is several bodies: {short}", "name one")
            body = self.spec.body(bodies[0])
        if config.camera is None:
            quat = _look(np.subtract(config.lookat, config.eye))
            camera = body.add_camera(name=f"//{name}", pos=config.eye, quat=quat, fovy=config.fov)
            return CameraMount(config, camera.name)
        prefix = f"{config.entity}/"
        names = [c.name.removeprefix(prefix) for c in self.spec.cameras if c.name.startswith(prefix)]
        if config.camera not in names:
            near = did_you_mean(config.camera, names) or f"cameras: {listing(names) if names else 'none'}"
            raise SceneProblem((*path, "camera"), f"no camera '{config.camera}' in the MJCF of '{config.entity}'", near)
        return CameraMount(config, prefix + config.camera)

    def _bodies(self, entity: str, patterns: str | list[str], path: tuple[str, ...], key: str) -> list[str]:
        """Full names of bodies of an entity."""
        if entity not in self.config.entities:
            near = did_you_mean(entity, self.config.entities) or f"entities: {listing(self.config.entities)}"
            raise SceneProblem((*path, "entity"), f"no entity '{entity}' in the scene", near)
        prefix = f"{entity}/"
        names = [body.name.removeprefix(prefix) for body in self.spec.bodies if body.name.startswith(prefix)]
        try:
            return [prefix + names[position] for position in match(patterns, names, "body")]
        except NameProblem as problem:
            raise SceneProblem((*path, key), str(problem), problem.hint) from None

    def _can_touch(self, body: str) -> bool:
        geoms = self.spec.body(body).geoms
        paired = {name for pair in self.spec.pairs for name in (pair.geomname1, pair.geomname2)}
        return any(geom.contype or geom.conaffinity or (geom.name and geom.name in paired) for geom in geoms)

    def _ground_geoms(self) -> list[mujoco.MjsGeom]:
        if self.ground is not None:
            return list(self.spec.body(TERRAIN).geoms)
        return [geom for geom in self.spec.worldbody.geoms if geom.name == "ground"]

    def _group_of_ground(self, path: tuple[str, ...]) -> int:
        """The geom group of the ground, made its own: a group is what a ray can be told to see."""
        ground = self._ground_geoms()
        if not ground:
            raise SceneProblem(path, "the scene has no ground", "add scene.ground or scene.terrain, or write sees: all")
        names = {geom.name for geom in ground}
        taken = {int(geom.group) for geom in self.spec.geoms if geom.name not in names}
        free = [group for group in _DRAWN_GROUPS if group not in taken]
        if not free:
            message = f"geoms of the entities are in all groups that are drawn, {listing(map(str, _DRAWN_GROUPS))}"
            raise SceneProblem(path, message, "leave one of them to the ground in the MJCF, or write sees: all")
        for geom in ground:
            geom.group = free[0]
        return free[0]


def joint_settings(entity: EntityConfig, joint: str) -> JointConfig:
    """What an entity's configuration says of a joint, later matches over earlier ones."""
    merged: dict[str, object] = {}
    for pattern, change in entity.joints.items():
        try:
            matched = bool(match(pattern, [joint], "joint"))
        except NameProblem:
            matched = False
        if matched:
            merged.update(change.model_dump(exclude_none=True))
    return JointConfig.model_validate(merged)


def actuator_kind(
    transmission: int, dynamics: int, gain: int, bias: int, gainprm: np.ndarray, biasprm: np.ndarray
) -> str:
    """motor, position, velocity or other, from an actuator's transmission, dynamics, gain and bias."""
    if transmission != int(mujoco.mjtTrn.mjTRN_JOINT) or gain != int(mujoco.mjtGain.mjGAIN_FIXED):
        return "other"
    if dynamics != int(mujoco.mjtDyn.mjDYN_NONE):
        return "other"
    if bias == int(mujoco.mjtBias.mjBIAS_NONE):
        return "motor"
    if bias == int(mujoco.mjtBias.mjBIAS_AFFINE):
        if biasprm[1] == -gainprm[0] != 0:
            return "position"
        if biasprm[1] == 0 and biasprm[2] == -gainprm[0] != 0:
            return "velocity"
    return "other"


def _spec_kind(a: mujoco.MjsActuator) -> str:
    return actuator_kind(int(a.trntype), int(a.dyntype), int(a.gaintype), int(a.biastype), a.gainprm, a.biasprm)


def _shape(entity: EntityConfig) -> mujoco.MjSpec:
    """A body with one geom."""
    assert entity.shape is not None
    assert entity.size is not None
    child = mujoco.MjSpec()
    body = child.worldbody.add_body(name="body", mocap=entity.mocap)
    if entity.free:
        body.add_freejoint(name="root")
    half = [edge / 2 for edge in entity.size]
    sizes = {
        "box": half,
        "sphere": entity.size,
        "cylinder": [entity.size[0], half[-1]],
        "capsule": [entity.size[0], half[-1]],
        "plane": [*half, 1.0],
    }
    size = sizes[entity.shape]
    body.add_geom(
        name="geom", type=_SHAPES[entity.shape], size=[*size, *[0.0] * (3 - len(size))], rgba=[*entity.color, 1.0],
        friction=[entity.friction, 0.005, 0.0001], density=entity.density or 1000.0,
        mass=np.nan if entity.mass is None else entity.mass,
    )  # fmt: skip
    return child


def name_all(child: mujoco.MjSpec) -> None:
    """Give what the MJCF leaves unnamed a name: an entity knows its elements by the prefix of their names."""
    for kind, elements in (
        ("body", child.bodies[1:]),
        ("joint", child.joints),
        ("site", child.sites),
        ("sensor", child.sensors),
        ("actuator", child.actuators),
        ("geom", child.geoms),
        ("tendon", child.tendons),
        ("pair", child.pairs),
    ):
        taken = {element.name for element in elements}
        for number, element in enumerate(elements):
            if not element.name:
                wanted = element.target if kind == "actuator" and element.target not in taken else f"{kind}_{number}"
                while wanted in taken:
                    wanted += "_"
                element.name = wanted
                taken.add(wanted)


def _settle_masses(child: mujoco.MjSpec) -> None:
    """Write down the mass and inertia of every body: attaching would lose the MJCF's `settotalmass`."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # MuJoCo means to drop the attribute; models have it
        model = child.compile()
    for body in child.bodies[1:]:
        compiled = model.body(body.name)
        body.explicitinertial = True
        body.fullinertia[:] = np.nan
        body.mass, body.inertia = float(compiled.mass[0]), compiled.inertia
        body.ipos, body.iquat = compiled.ipos, compiled.iquat
    child.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    child.compiler.settotalmass = -1.0


def _override(joint: mujoco.MjsJoint, change: JointConfig, *, degrees: bool) -> None:
    for key, attribute in (
        ("damping", "damping"),
        ("stiffness", "stiffness"),
        ("armature", "armature"),
        ("friction_loss", "frictionloss"),
    ):
        value = getattr(change, key)
        if value is not None:
            current = getattr(joint, attribute)
            if isinstance(current, np.ndarray):  # MuJoCo 4 has polynomial damping and stiffness: the linear term
                current[:] = 0.0
                current[0] = value
            else:
                setattr(joint, attribute, value)
    if change.range is not None:
        # a spec keeps angles in the unit of the MJCF it came from
        turn = 180.0 / np.pi if degrees and joint.type == mujoco.mjtJoint.mjJNT_HINGE else 1.0
        joint.range = [turn * end for end in change.range]
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE


def _look(ray: np.ndarray) -> np.ndarray:
    """The attitude of a camera, which looks along its own -z, that looks along a ray with z, or else x, up."""
    back = -ray / np.linalg.norm(ray)
    right = np.cross([0.0, 0.0, 1.0], back)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross([1.0, 0.0, 0.0], back)
    right /= np.linalg.norm(right)
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.stack([right, np.cross(back, right), back], axis=1).flatten())
    return quat


def _limit(actuator: mujoco.MjsActuator, effort: float) -> None:
    force = effort / (abs(actuator.gear[0]) or 1.0)  # MuJoCo's limit is before the gear, ours is on the joint
    actuator.forcerange = [-force, force]
    actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())

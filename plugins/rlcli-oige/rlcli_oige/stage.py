"""What a task builds its scene of: prims on a stage, robots and shapes, each an MJCF model of the scene in the end."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from rlcli.config.schema import EntityConfig
from rlcli.errors import ConfigError, Problem, TaskError, did_you_mean, listing
from rlcli.scene.scene import Scene
from rlcli.scene.untrusted_mjcf import BadModel, package_roots, read_mjcf
from rlcli_oige.task_yaml import home, relative

MODELS = Path(__file__).parent / "models"
BASE = "/World/envs"
ZERO = f"{BASE}/env_0"

_OPEN: list[Stage] = []


class Prim:
    """A robot or a shape of the first environment; all environments get it."""

    def __init__(self, stage: Stage, path: str) -> None:
        self.stage = stage
        self.prim_path = path
        self.child: mujoco.MjSpec | None = None
        self.label = ""
        self.shape = False
        self.pos: tuple[float, ...] = (0.0, 0.0, 0.0)
        self.quat: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
        self.settings: dict[str, Any] = {}
        self.names: dict[str, Mapping[str, str]] = {}

    @property
    def entity(self) -> str:
        """Name of the entity that this becomes."""
        return relative(self.prim_path).replace("/", "_")

    def GetPath(self) -> str:  # noqa: N802  (USD's name)
        """The path of the prim."""
        return self.prim_path

    def GetName(self) -> str:  # noqa: N802
        """The last part of the path."""
        return self.prim_path.rpartition("/")[2]

    def IsValid(self) -> bool:  # noqa: N802
        """A prim that was found is valid."""
        return True

    def GetChildren(self) -> list[Prim]:  # noqa: N802
        """Nothing: what a model holds is its own."""
        return []


class Stage:
    """All prims of a task under construction, by path.

    Args:
        models: robot, by its path in an environment -> model file and names, as the task's `mjcf:` has it.
        root: the task's folder.
    """

    def __init__(self, models: Mapping[str, Any], root: Path) -> None:
        self.models = models
        self.root = root
        self.prims: dict[str, Prim] = {}

    def GetPrimAtPath(self, path: str) -> Prim:  # noqa: N802
        """`get_prim_at_path`."""
        return self.find(path)

    def find(self, path: str) -> Prim:
        """The prim at a path, or the one whose model the path leads into.

        Raises:
            TaskError: if nothing stands there.
        """
        path = str(path)
        while path and path != "/":
            if path in self.prims:
                return self.prims[path]
            path = path.rpartition("/")[0]
        raise TaskError("there is no prim at that path", hint=f"prims: {listing(self.prims)}")

    def define(self, path: str, pos: Any, quat: Any) -> Prim:
        """A new prim."""
        prim = self.prims[path] = Prim(self, path)
        prim.pos, prim.quat = _numbers(pos, (0.0, 0.0, 0.0)), _numbers(quat, (1.0, 0.0, 0.0, 0.0))
        return prim

    def load(self, prim: Prim, kinds: list[str]) -> None:
        """Give a robot its model: the one that the YAML names, or the one of its class.

        Raises:
            ConfigError: if there is none, or it cannot be read.
        """
        path = relative(prim.prim_path)
        key = next((k for k in (path, path.rpartition("/")[2], *kinds) if k in self.models), None)
        entry = self.models[key] if key is not None else {}
        built_in = next((MODELS / f"{kind.lower()}.xml" for kind in kinds if kind in ROBOTS), None)
        file = (self.root / entry["model"]).resolve() if entry else built_in
        where = f"mjcf.{key or path}"
        if file is None:
            hint = f"add mjcf: {{{path}: FILE.xml}} to the task's YAML"
            raise ConfigError([Problem(where, "", f"no model stands for the robot at '{prim.prim_path}'", hint)])
        if not file.is_file():
            have = listing(sorted(str(p.relative_to(self.root)) for p in self.root.rglob("*.xml")))
            raise ConfigError([Problem(where, "", f"no file '{file}'", f"MJCF files of the task: {have}")])
        try:
            prim.child = read_mjcf(file, [*package_roots(self.root), home(self.root / "task.yaml"), MODELS])
        except BadModel as error:
            raise ConfigError([Problem(where, "", f"'{file}' is not a valid MJCF: {error}")]) from None
        prim.label = str(entry.get("model", file.name))
        prim.names = {"joints": entry.get("joints", {}), "bodies": entry.get("bodies", {})}
        self._rename(prim, where)

    def attach(self, scene: Scene, joint_forces: bool) -> None:
        """Turn every prim into an entity of the scene; with sensors of joint forces where a task reads them."""
        # robots before shapes: the options of the scene are those of its first model; a frame has none
        for prim in sorted(self.prims.values(), key=lambda prim: prim.shape):
            if prim.child is None:
                continue
            _apply(prim, prim.child)
            if joint_forces:
                _add_force_sensors(prim.child)
            entity = EntityConfig(model=prim.label, pos=prim.pos, quat=prim.quat)  # type: ignore[arg-type]
            scene.attach(prim.entity, entity, prim.child)

    def _rename(self, prim: Prim, where: str) -> None:
        """Give joints and bodies the names that the task knows them by."""
        assert prim.child is not None
        kinds = {"joints": list(prim.child.joints), "bodies": list(prim.child.bodies)}
        for kind, names in prim.names.items():
            known = {element.name: element for element in kinds[kind]}
            for new, old in names.items():
                if old not in known:
                    near = did_you_mean(old, known) or f"{kind}: {listing(known)}"
                    raise ConfigError([Problem(f"{where}.{kind}.{new}", "", f"no '{old}' in {prim.label}", near)])
            for old, element in known.items():
                new_names = [new for new, was in names.items() if was == old]
                if new_names:
                    element.name = new_names[0]


@contextlib.contextmanager
def opened(stage: Stage) -> Iterator[Stage]:
    """Robots made inside stand on this stage."""
    _OPEN.append(stage)
    try:
        yield stage
    finally:
        _OPEN.remove(stage)


def get_current_stage() -> Stage:
    """The stage of the task that is being built.

    Raises:
        TaskError: outside `set_up_scene`.
    """
    if not _OPEN:
        raise TaskError("there is no stage", hint="robots and shapes are made in the task's set_up_scene")
    return _OPEN[-1]


def get_prim_at_path(prim_path: str) -> Prim:
    """The prim at a path, or the one whose model the path leads into."""
    return get_current_stage().find(prim_path)


def is_prim_path_valid(prim_path: str) -> bool:
    """Whether something stands at a path."""
    return any(prim_path == path or prim_path.startswith(f"{path}/") for path in get_current_stage().prims)


def find_matching_prim_paths(prim_path_regex: str) -> list[str]:
    """Paths of the prims that a regular expression matches, in the first environment."""
    pattern = path_pattern(prim_path_regex)
    return [path for path in get_current_stage().prims if pattern.fullmatch(path)]


def define_prim(prim_path: str, prim_type: str = "Xform", **kwargs: Any) -> Prim:
    """A frame."""
    return get_current_stage().define(prim_path, None, None)


def add_reference_to_stage(usd_path: str, prim_path: str, prim_type: str = "Xform") -> None:
    """Nothing: what stands at a path is said by the YAML's `mjcf:`."""


def get_assets_root_path() -> str:
    """Nothing is downloaded; USD paths begin with this."""
    return ""


def path_pattern(expression: str) -> re.Pattern[str]:
    """A view's `prim_paths_expr`: its `.*` and `*` stand for part of one step of a path."""
    steps = str(expression).rstrip("/").split("/")
    steps = ["[^/]*" if step == "*" else step.replace(".*", "[^/]*") for step in steps]
    try:
        return re.compile("/".join(steps))
    except re.error as error:
        raise TaskError(f"'{expression}' is not a path expression: {error}") from None


class XFormPrim:
    """A frame."""

    def __init__(
        self,
        prim_path: str,
        name: str = "xform_prim",
        position: Any = None,
        translation: Any = None,
        orientation: Any = None,
        scale: Any = None,
        visible: bool | None = None,
        **kwargs: Any,
    ) -> None:
        self.prim_path = str(prim_path)
        self.name = name
        self.prim = get_current_stage().define(
            self.prim_path, position if translation is None else translation, orientation
        )
        self._build(scale)

    def _build(self, scale: Any) -> None:
        """Fill the prim."""

    def set_collision_enabled(self, enabled: bool) -> None:
        """Whether it touches anything."""
        self.prim.settings["collisions"] = bool(enabled)


class Robot(XFormPrim):
    """A robot; its model is the one that the YAML's `mjcf:` gives its path, or the built-in one of its class."""

    def _build(self, scale: Any) -> None:
        self.prim.stage.load(self.prim, [kind.__name__ for kind in type(self).__mro__])


class Cartpole(Robot):
    """A cart on a rail with a pole."""


class Ant(Robot):
    """A four-legged walker."""


class Humanoid(Robot):
    """A two-legged walker with arms."""


class Crazyflie(Robot):
    """A palm-sized quadcopter."""


class Quadcopter(Robot):
    """A quadcopter whose arms tilt."""


class Ingenuity(Robot):
    """A helicopter with two rotors, one above the other."""


ROBOTS = ("Cartpole", "Ant", "Humanoid", "Crazyflie", "Quadcopter", "Ingenuity")
"""Robots that bring a model of their own."""


class RigidPrim(XFormPrim):
    """A frame that a model fills."""


class _Shape(XFormPrim):
    free, solid = True, True

    def __init__(self, prim_path: str, name: str = "shape", radius: float | None = None, size: Any = None,
                 height: float | None = None, color: Any = None, mass: float | None = None,
                 density: float | None = None, **kwargs: Any) -> None:  # fmt: skip
        self._radius, self._size, self._height = radius, size, height
        self._color, self._mass, self._density = color, mass, density
        super().__init__(prim_path, name, **kwargs)

    def _geom(self, scale: np.ndarray) -> dict[str, Any]:
        raise NotImplementedError

    def _build(self, scale: Any) -> None:
        child = mujoco.MjSpec()
        body = child.worldbody.add_body(name=self.prim.GetName())
        if self.free:
            body.add_freejoint(name="root")
        rgb = _numbers(self._color, (0.5, 0.5, 0.5))
        size = np.broadcast_to(np.asarray(_numbers(scale, (1.0, 1.0, 1.0))), 3)
        geom = body.add_geom(name="shape", rgba=[*rgb[:3], 1.0], **self._geom(size))
        if self._mass is not None:
            geom.mass = float(self._mass)
        geom.density = float(self._density) if self._density is not None else 1000.0
        self.prim.child, self.prim.label, self.prim.shape = child, type(self).__name__, True
        self.prim.settings["collisions"] = self.solid


class _Sphere(_Shape):
    def _geom(self, scale: np.ndarray) -> dict[str, Any]:
        radius = (1.0 if self._radius is None else float(self._radius)) * scale[0]
        return {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [radius, 0.0, 0.0]}


class _Cuboid(_Shape):
    def _geom(self, scale: np.ndarray) -> dict[str, Any]:
        edges = np.broadcast_to(np.asarray(_numbers(self._size, (1.0,))), 3) * scale
        return {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": (0.5 * edges).tolist()}


class _Cylinder(_Shape):
    def _geom(self, scale: np.ndarray) -> dict[str, Any]:
        radius, height = self._radius or 1.0, self._height or 1.0
        return {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": [radius * scale[0], 0.5 * height * scale[2], 0.0]}


class DynamicSphere(_Sphere):
    """A ball that moves and touches."""


class FixedSphere(_Sphere):
    """A ball that stands where it is."""

    free = False


class VisualSphere(_Sphere):
    """A ball that is only seen."""

    free, solid = False, False


class DynamicCuboid(_Cuboid):
    """A box that moves and touches."""


class FixedCuboid(_Cuboid):
    """A box that stands where it is."""

    free = False


class VisualCuboid(_Cuboid):
    """A box that is only seen."""

    free, solid = False, False


class DynamicCylinder(_Cylinder):
    """A cylinder that moves and touches."""


class FixedCylinder(_Cylinder):
    """A cylinder that stands where it is."""

    free = False


class GroundPlane:
    """The ground; `sim.add_ground_plane` of the YAML decides whether there is one."""

    def __init__(self, prim_path: str = "/World/defaultGroundPlane", **kwargs: Any) -> None:
        self.prim_path = prim_path


def _apply(prim: Prim, child: mujoco.MjSpec) -> None:
    """The settings of an actor, on its model."""
    settings = prim.settings
    for geom in child.geoms:
        if settings.get("collisions") is False:
            geom.contype = geom.conaffinity = 0
        if settings.get("density", -1) not in (-1, None):
            geom.density, geom.mass = float(settings["density"]), np.nan
    if settings.get("make_kinematic") in (True, 1):
        for body in child.worldbody.bodies:
            for joint in [j for j in body.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]:
                child.delete(joint)
            body.mocap = True
    if settings.get("disable_gravity") is True:
        for body in child.bodies[1:]:
            body.gravcomp = 1.0
    if settings.get("enable_self_collisions") in (False, 0):
        _exclude(child)
    if settings.get("mass", -1) not in (-1, None):
        model = child.compile()
        factor = float(settings["mass"]) / float(np.sum(model.body_mass))
        for geom in child.geoms:
            if np.isnan(geom.mass):
                geom.density *= factor
            else:
                geom.mass *= factor
        for body in child.bodies[1:]:
            if body.explicitinertial:
                body.mass *= factor
                body.inertia = factor * np.asarray(body.inertia)


def _exclude(child: mujoco.MjSpec) -> None:
    """No two bodies of the model touch each other."""
    for number, body in enumerate(child.bodies[1:]):
        if not body.name:
            body.name = f"body_{number}"  # as an entity names what its MJCF does not
    bodies = [b for b in child.bodies[1:] if any(g.contype or g.conaffinity for g in b.geoms)]
    for number, first in enumerate(bodies):
        for second in bodies[number + 1 :]:
            touching = any(
                (a.contype & b.conaffinity) or (b.contype & a.conaffinity) for a in first.geoms for b in second.geoms
            )
            if touching:
                child.add_exclude(bodyname1=first.name, bodyname2=second.name)


def _add_force_sensors(child: mujoco.MjSpec) -> None:
    """The wrench that a body's parent holds it with, at the body's frame: what `get_measured_joint_forces` reads."""
    for number, body in enumerate(child.bodies[1:]):
        if not body.name:
            body.name = f"body_{number}"
        body.add_site(name=f"{body.name}{FRAME}", pos=[0.0, 0.0, 0.0], size=[1e-3] * 3, group=5)
    for body in child.bodies[1:]:
        for kind, suffix in ((mujoco.mjtSensor.mjSENS_FORCE, FORCE), (mujoco.mjtSensor.mjSENS_TORQUE, TORQUE)):
            child.add_sensor(
                name=f"{body.name}{suffix}",
                type=kind,
                objtype=mujoco.mjtObj.mjOBJ_SITE,
                objname=f"{body.name}{FRAME}",
            )


FRAME, FORCE, TORQUE = ".frame", ".joint_force", ".joint_torque"
"""Endings of the names of sites and sensors that measure joint forces."""


def _numbers(value: Any, default: tuple[float, ...]) -> tuple[float, ...]:
    if value is None:
        return default
    return tuple(float(x) for x in np.asarray(value, dtype=float).reshape(-1))

"""Stage, prims, robots and shapes that a task builds its scene from. Each becomes an MJCF model of the scene."""

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

_CURRENT_STAGES: list[Stage] = []


class Prim:
    """A robot or a shape of the first environment; every environment gets a copy."""

    def __init__(self, stage: Stage, path: str) -> None:
        self.stage = stage
        self.prim_path = path
        self.child: mujoco.MjSpec | None = None
        self.label = ""
        self.shape = False
        self.pos: tuple[float, ...] | None = None
        self.quat: tuple[float, ...] | None = None
        self.settings: dict[str, Any] = {}
        self.names: dict[str, Mapping[str, str]] = {}

    @property
    def entity(self) -> str:
        """Name of the entity in rlcli's scene."""
        return relative(self.prim_path).replace("/", "_")

    def GetPath(self) -> str:  # noqa: N802  (USD's name)
        """Return the path."""
        return self.prim_path

    def GetName(self) -> str:  # noqa: N802
        """Return the last part of the path."""
        return self.prim_path.rpartition("/")[2]

    def IsValid(self) -> bool:  # noqa: N802
        """Return True: every prim that was found is valid."""
        return True

    def GetChildren(self) -> list[Prim]:  # noqa: N802
        """Return an empty list: the elements of a model are no prims."""
        return []


class Stage:
    """Prims of a task under construction, by path.

    Args:
        models: robot, by its path in an environment -> model file and names, as the task's `mjcf:` has it.
        root: the task's folder.
    """

    def __init__(self, models: Mapping[str, Any], root: Path) -> None:
        self.models = models
        self.root = root
        self.prims: dict[str, Prim] = {}

    def GetPrimAtPath(self, path: str) -> Prim:  # noqa: N802
        """Return the prim at a path, like `find`."""
        return self.find(path)

    def find(self, path: str) -> Prim:
        """Return the prim at a path, or the prim whose model contains the path.

        Raises:
            TaskError: if there is none.
        """
        prefix = str(path)
        while prefix and prefix != "/":
            if prefix in self.prims:
                return self.prims[prefix]
            prefix = prefix.rpartition("/")[0]
        raise TaskError(f"no prim at '{path}'", hint=f"prims: {listing(self.prims)}")

    def define(self, path: str, pos: Any, quat: Any) -> Prim:
        """Add a prim."""
        prim = self.prims[path] = Prim(self, path)
        prim.pos, prim.quat = (None if value is None else _to_floats(value, ()) for value in (pos, quat))
        return prim

    def load(self, prim: Prim, kinds: list[str]) -> None:
        """Load a robot's model: the file that the YAML names, or the built-in one of its class.

        Raises:
            ConfigError: if there is no model, or it cannot be read.
        """
        path = relative(prim.prim_path)
        key = next((k for k in (path, path.rpartition("/")[2], *kinds) if k in self.models), None)
        entry = self.models[key] if key is not None else {}
        built_in = next((MODELS / f"{kind.lower()}.xml" for kind in kinds if kind in ROBOTS), None)
        file = (self.root / entry["model"]).resolve() if entry else built_in
        where = f"mjcf.{key or path}"
        if file is None:
            hint = f"add mjcf: {{{path}: FILE.xml}} to the task's YAML"
            raise ConfigError([Problem(where, "", f"the robot at '{prim.prim_path}' has no model", hint)])
        if not file.is_file():
            have = listing(sorted(str(p.relative_to(self.root)) for p in self.root.rglob("*.xml")))
            raise ConfigError([Problem(where, "", f"no file '{file}'", f"MJCF files of the task: {have}")])
        try:
            prim.child = read_mjcf(file, [*package_roots(self.root), home(self.root / "task.yaml"), MODELS])
        except BadModel as error:
            raise ConfigError([Problem(where, "", f"'{file}' is not a valid MJCF; correct it: {error}")]) from None
        prim.label = str(entry.get("model", file.name))
        prim.names = {"joints": entry.get("joints", {}), "bodies": entry.get("bodies", {})}
        self._rename_elements(prim, where)

    def attach(self, scene: Scene, joint_forces: bool) -> None:
        """Add every prim to the scene as an entity, with sensors of joint forces if a task reads them."""
        # robots before shapes: the scene takes its options from its first model
        for prim in sorted(self.prims.values(), key=lambda prim: prim.shape):
            if prim.child is None:
                continue
            _apply_settings(prim, prim.child)
            if joint_forces:
                _add_force_sensors(prim.child)
            entity = EntityConfig(model=prim.label, pos=prim.pos, quat=prim.quat)  # type: ignore[arg-type]
            scene.attach(prim.entity, entity, prim.child)

    def _rename_elements(self, prim: Prim, where: str) -> None:
        """Give joints and bodies the names that the task uses."""
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
def current_stage(stage: Stage) -> Iterator[Stage]:
    """Make a stage the current one, on which robots and shapes are created."""
    _CURRENT_STAGES.append(stage)
    try:
        yield stage
    finally:
        _CURRENT_STAGES.remove(stage)


def get_current_stage() -> Stage:
    """Return the stage of the task that is being built.

    Raises:
        TaskError: outside of `set_up_scene`.
    """
    if not _CURRENT_STAGES:
        raise TaskError("the task has no stage yet", hint="create robots and shapes in the task's set_up_scene")
    return _CURRENT_STAGES[-1]


def get_prim_at_path(prim_path: str) -> Prim:
    """Return the prim at a path, or the prim whose model contains the path."""
    return get_current_stage().find(prim_path)


def is_prim_path_valid(prim_path: str) -> bool:
    """Return whether there is a prim at a path."""
    return any(prim_path == path or prim_path.startswith(f"{path}/") for path in get_current_stage().prims)


def find_matching_prim_paths(prim_path_regex: str) -> list[str]:
    """Return the paths of the prims that a regular expression matches, in the first environment."""
    pattern = path_pattern(prim_path_regex)
    return [path for path in get_current_stage().prims if pattern.fullmatch(path)]


def define_prim(prim_path: str, prim_type: str = "Xform", **kwargs: Any) -> Prim:
    """Add a frame."""
    return get_current_stage().define(prim_path, None, None)


def add_reference_to_stage(usd_path: str, prim_path: str, prim_type: str = "Xform") -> None:
    """Do nothing: the YAML's `mjcf:` names the model of each path."""


def get_assets_root_path() -> str:
    """Return the start of USD paths. It is empty: nothing is downloaded."""
    return ""


def path_pattern(expression: str) -> re.Pattern[str]:
    """Compile a view's `prim_paths_expr`. `.*` and `*` match within one step of the path."""
    steps = str(expression).rstrip("/").split("/")
    steps = ["[^/]*" if step == "*" else step.replace(".*", "[^/]*") for step in steps]
    try:
        return re.compile("/".join(steps))
    except re.error as error:
        raise TaskError(
            f"'{expression}' is not a valid regular expression of prim paths; correct it: {error}"
        ) from None


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
        """Fill the prim with a model."""

    def set_collision_enabled(self, enabled: bool) -> None:
        """Turn collisions on or off."""
        self.prim.settings["collisions"] = bool(enabled)


class Robot(XFormPrim):
    """A robot. The YAML's `mjcf:` names its model; some classes have a built-in model."""

    def _build(self, scale: Any) -> None:
        self.prim.stage.load(self.prim, [kind.__name__ for kind in type(self).__mro__])


class Cartpole(Robot):
    """A cart on a rail with a pole."""


class Ant(Robot):
    """A robot with four legs."""


class Humanoid(Robot):
    """A humanoid robot."""


class Crazyflie(Robot):
    """A palm-sized quadcopter."""


class Quadcopter(Robot):
    """A quadcopter whose arms tilt."""


class Ingenuity(Robot):
    """A helicopter with two rotors, one above the other."""


ROBOTS = ("Cartpole", "Ant", "Humanoid", "Crazyflie", "Quadcopter", "Ingenuity")
"""Classes of robots with a built-in model."""


class RigidPrim(XFormPrim):
    """A frame whose model is loaded separately."""


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
        rgb = _to_floats(self._color, (0.5, 0.5, 0.5))
        size = np.broadcast_to(np.asarray(_to_floats(scale, (1.0, 1.0, 1.0))), 3)
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
        edges = np.broadcast_to(np.asarray(_to_floats(self._size, (1.0,))), 3) * scale
        return {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": (0.5 * edges).tolist()}


class _Cylinder(_Shape):
    def _geom(self, scale: np.ndarray) -> dict[str, Any]:
        radius, height = self._radius or 1.0, self._height or 1.0
        return {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": [radius * scale[0], 0.5 * height * scale[2], 0.0]}


class DynamicSphere(_Sphere):
    """A sphere that moves and collides."""


class FixedSphere(_Sphere):
    """A sphere that is fixed and collides."""

    free = False


class VisualSphere(_Sphere):
    """A sphere without collisions."""

    free, solid = False, False


class DynamicCuboid(_Cuboid):
    """A box that moves and collides."""


class FixedCuboid(_Cuboid):
    """A box that is fixed and collides."""

    free = False


class VisualCuboid(_Cuboid):
    """A box without collisions."""

    free, solid = False, False


class DynamicCylinder(_Cylinder):
    """A cylinder that moves and collides."""


class FixedCylinder(_Cylinder):
    """A cylinder that is fixed and collides."""

    free = False


class GroundPlane:
    """The ground plane. `sim.add_ground_plane` of the YAML decides whether the scene has one."""

    def __init__(self, prim_path: str = "/World/defaultGroundPlane", **kwargs: Any) -> None:
        self.prim_path = prim_path


def _apply_settings(prim: Prim, child: mujoco.MjSpec) -> None:
    """Apply the settings of an actor to its model."""
    settings = prim.settings
    for geom in child.geoms:
        if settings.get("collisions") is False:
            geom.contype = geom.conaffinity = 0
        if settings.get("density", -1) not in (-1, None):
            geom.density, geom.mass = float(settings["density"]), np.nan  # NaN: MuJoCo computes the mass
    if settings.get("make_kinematic") in (True, 1):
        for body in child.worldbody.bodies:
            for joint in [j for j in body.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]:
                child.delete(joint)
            body.mocap = True
    if settings.get("disable_gravity") is True:
        for body in child.bodies[1:]:
            body.gravcomp = 1.0
    if settings.get("enable_self_collisions") in (False, 0):
        _disable_self_collisions(child)
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


def _disable_self_collisions(child: mujoco.MjSpec) -> None:
    """Exclude contacts between all bodies of the model."""
    for number, body in enumerate(child.bodies[1:]):
        if not body.name:
            body.name = f"body_{number}"  # the name that an entity gives to a body without one
    bodies = [b for b in child.bodies[1:] if any(g.contype or g.conaffinity for g in b.geoms)]
    for number, first in enumerate(bodies):
        for second in bodies[number + 1 :]:
            collide = any(
                (a.contype & b.conaffinity) or (b.contype & a.conaffinity) for a in first.geoms for b in second.geoms
            )
            if collide:
                child.add_exclude(bodyname1=first.name, bodyname2=second.name)


def _add_force_sensors(child: mujoco.MjSpec) -> None:
    """Add sensors of the force and torque between each body and its parent, in the body's frame."""
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
"""Suffixes of the sites and sensors that measure joint forces."""


def _to_floats(value: Any, default: tuple[float, ...]) -> tuple[float, ...]:
    if value is None:
        return default
    return tuple(float(x) for x in np.asarray(value, dtype=float).reshape(-1))

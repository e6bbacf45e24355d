"""USD's stage and prims, with which a task builds its scene: robots, objects and shapes become rlcli's entities."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from rlcli.config.schema import EntityConfig
from rlcli.errors import ConfigError, Problem, TaskError, did_you_mean, listing
from rlcli.scene.mjcf_safety_check import BadModel
from rlcli.scene.scene import Scene
from rlcli.scene.untrusted_mjcf import package_roots, read_mjcf
from rlcli_oige.model_edits import add_force_sensors, apply_schemas, apply_settings
from rlcli_oige.prim_paths import BASE, ZERO, path_pattern
from rlcli_oige.task_yaml import home, relative
from rlcli_oige.terrain_mesh import add_terrain
from rlcli_oige.user_code import Counterpart, user_location

if TYPE_CHECKING:
    from torch import Tensor

    from rlcli_oige.usd_schemas import Attribute

MODELS = Path(__file__).parent / "models"

_CURRENT_STAGES: list[Stage] = []


class Prim(Counterpart):
    """Object of the stage (USD's word is prim): a model, a body or joint of a model, or a frame.

    The prims of models are those of the first environment; every environment has a copy.
    """

    def __init__(self, stage: Stage, path: str, owner: Prim | None = None, element: Any = None) -> None:
        self.stage = stage
        self.prim_path = path
        self.owner = owner or self
        self.element = element
        """The body or joint of the owner's model; None: the prim is the whole model, or it has no model."""
        self.child: mujoco.MjSpec | None = None
        self.label = ""
        self.shape = False
        self.pos: tuple[float, ...] = (0.0, 0.0, 0.0)
        self.quat: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)
        self.given: set[str] = set()
        """Which of `pos` and `quat` the task has set; the model has the value of the other one."""
        self.names: dict[str, Mapping[str, str]] = {}
        self.kind = ""
        """Type of the prim in USD, for prims without a model."""
        self.attributes: dict[tuple[str, str, str], Attribute] = {}
        """(schema, instance of the schema, name) -> attribute."""
        self._settings: dict[str, Any] = {}

    @property
    def settings(self) -> dict[str, Any]:
        """Settings of the actor (robot or object) that the prim belongs to, such as `mass`."""
        return self.owner._settings

    @property
    def entity(self) -> str:
        """Name of the entity in rlcli's scene."""
        return relative(self.prim_path).replace("/", "_")

    def is_body(self) -> bool:
        """Return whether the prim is a body of a model."""
        return isinstance(self.element, mujoco.MjsBody)

    def is_joint(self) -> bool:
        """Return whether the prim is a joint of a model."""
        return isinstance(self.element, mujoco.MjsJoint)

    def GetPath(self) -> str:  # noqa: N802  (USD's names)
        """Return the path of the prim."""
        return self.prim_path

    GetPrimPath = GetPath

    def GetPrim(self) -> Prim:  # noqa: N802
        """Return the prim itself."""
        return self

    def GetName(self) -> str:  # noqa: N802
        """Return the last part of the prim's path."""
        return self.prim_path.rpartition("/")[2]

    def GetStage(self) -> Stage:  # noqa: N802
        """Return the stage that the prim belongs to."""
        return self.stage

    def GetTypeName(self) -> str:  # noqa: N802
        """Return the type of the prim in USD, such as `Camera`; `Xform` (a frame) for a prim without a type."""
        return self.kind or "Xform"

    def IsValid(self) -> bool:  # noqa: N802
        """Return whether the prim exists."""
        return self.stage.prims.get(self.prim_path) is self or self.element is not None

    __bool__ = IsValid

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Prim) and other.prim_path == self.prim_path

    def __hash__(self) -> int:
        return hash(self.prim_path)

    def GetChildren(self) -> list[Prim]:  # noqa: N802
        """Return the bodies of a model, the joints below a body, or the prims below a frame."""
        child = self.owner.child
        if child is None:
            depth = self.prim_path.count("/") + 1
            below = (prim for path, prim in self.stage.prims.items() if path.startswith(f"{self.prim_path}/"))
            return [prim for prim in below if prim.prim_path.count("/") == depth]
        if self.is_body():
            joints = [joint for body in self.element.bodies for joint in body.joints]
            return [self._part(f"{self.prim_path}/{joint.name}", joint) for joint in joints]
        if self.is_joint():
            return []
        return [self._part(f"{self.prim_path}/{body.name}", body) for body in child.bodies[1:]]

    def part(self, path: str) -> Prim:
        """Return the body or joint that the last part of a path names; an invalid prim if there is none."""
        name = path.rpartition("/")[2]
        assert self.child is not None
        below_joints = path.removeprefix(self.prim_path).count("/") > 1
        kinds = (self.child.joints, self.child.bodies) if below_joints else (self.child.bodies, self.child.joints)
        element = next((element for kind in kinds for element in kind if element.name == name), None)
        return self._part(path, element)

    def _part(self, path: str, element: Any) -> Prim:
        parts = self.stage.parts.setdefault(self.prim_path if element is None else self.owner.prim_path, {})
        key = path if element is None else f"{type(element).__name__}/{element.name}"
        if key not in parts:
            parts[key] = Prim(self.stage, path, self.owner, element)
        return parts[key]

    # USD's methods for schemas and attributes

    def HasAPI(self, schema: Any, instance: str = "") -> bool:  # noqa: N802
        """Return whether a schema is applied to the prim, or belongs to the prims of its kind."""
        return bool(schema.is_on(self))

    def GetAttribute(self, name: str) -> Attribute:  # noqa: N802
        """Return an attribute. The position of an environment is its position on the grid."""
        from rlcli_oige.usd_schemas import Attribute

        attribute = self.attributes.setdefault(("", "", name), Attribute(self, "", "", name))
        if name == "xformOp:translate" and attribute.value is None:
            attribute.value = self.stage.position(self)
        return attribute

    CreateAttribute = HasAttribute = GetAttribute

    def GetAppliedSchemas(self) -> list[str]:  # noqa: N802
        """Return the names of the schemas whose attributes were set."""
        return sorted({schema for schema, _, _ in self.attributes if schema})


class Stage(Counterpart):
    """Prims of a task under construction, by path.

    Args:
        models: name of a robot or object -> model file and names, as `mjcf:` and `--model` set it.
        root: the task's folder.
        grid: position of each environment. (num_envs, 3) [m]
    """

    def __init__(self, models: Mapping[str, Any], root: Path, grid: Tensor | None = None) -> None:
        self.models = models
        self.root = root
        self.grid = grid
        self.prims: dict[str, Prim] = {}
        self.parts: dict[str, dict[str, Prim]] = {}
        self.references: dict[str, str] = {}
        """Path of a prim -> USD file that the task refers to."""
        self.labelled: set[str] = set()
        """Paths of the prims with a semantic label, relative to their environment."""
        self.ignored: dict[str, str] = {}
        """Call of the task that has no effect -> where it is, and the reason."""
        self.lost: dict[str, str] = {}
        """Like `ignored`, for calls that change the motion in OmniIsaacGymEnvs."""

    def GetPrimAtPath(self, path: Any) -> Prim:  # noqa: N802
        """Return the prim at a path. If there is none, return a prim whose `IsValid()` is False."""
        path = str(path).rstrip("/")
        if path in self.prims:
            return self.prims[path]
        in_first = f"{ZERO}/" + "/".join(path.split("/")[4:])
        if path.startswith(f"{BASE}/env_") and not path.startswith(f"{ZERO}/") and path.count("/") > 3:
            return self.GetPrimAtPath(in_first)
        if path.startswith(f"{BASE}/env_") and path.count("/") == 3:
            return self.define(path, None, None)
        prefix = path
        while prefix := prefix.rpartition("/")[0]:
            owner = self.prims.get(prefix)
            if owner is not None and owner.child is not None:
                return owner.part(path)
        return Prim(self, path)

    def find(self, path: str) -> Prim:
        """Return the prim at a path, or the prim whose model contains the path.

        Raises:
            TaskError: if there is none.
        """
        prim = self.GetPrimAtPath(path)
        if prim.owner is prim and not prim.IsValid():
            raise TaskError(f"{user_location()}no prim at '{path}'", hint=f"prims: {listing(self.prims)}")
        return prim

    def DefinePrim(self, path: Any, kind: str = "Xform") -> Prim:  # noqa: N802
        """Add a prim without a model; `kind` is its type in USD, such as `Camera`."""
        prim = self.define(str(path), None, None)
        prim.kind = kind
        return prim

    def RemovePrim(self, path: Any) -> None:  # noqa: N802
        """Remove the prim at a path, if there is one."""
        self.prims.pop(str(path), None)

    def define(self, path: str, pos: Any, quat: Any) -> Prim:
        """Add a prim, or set the pose of an existing one. For a path inside of a USD file, the whole model moves."""
        reference = next((ref for ref in self.references if path == ref or path.startswith(f"{ref}/")), None)
        if reference is not None and reference not in self.prims and reference != path:
            self.define(reference, None, None)
            self.load(self.prims[reference], [])
        prim = self.prims.get(path if reference is None else reference) or Prim(self, path)
        if pos is not None:
            prim.pos = to_floats(pos, ())
            prim.given.add("pos")
        if quat is not None:
            prim.quat = to_floats(quat, ())
            prim.given.add("quat")
        self.prims[prim.prim_path] = prim
        return prim if path == prim.prim_path else prim.part(path)

    def position(self, prim: Prim) -> Any:
        """Return the position of an environment on the grid, or of a prim in its environment. (3,) [m]"""
        parts = prim.prim_path.split("/")
        if self.grid is not None and len(parts) == 4 and parts[3].removeprefix("env_").isdigit():
            return self.grid[int(parts[3].removeprefix("env_"))].cpu().numpy().astype(float)
        return np.array(prim.owner.pos, dtype=float)

    def load(self, prim: Prim, kinds: list[str]) -> None:
        """Load the model of a prim: the file that `--model` or the YAML names, or the built-in one of its class.

        Raises:
            ConfigError: if there is no model, or it cannot be read.
        """
        path = relative(prim.prim_path)
        usd = Path(self.references.get(prim.prim_path, "")).stem
        names = (path, path.rpartition("/")[2], *kinds, usd)
        key = next((name for name in names if name and name in self.models), None)
        entry = self.models[key] if key is not None else {}
        entry = {"model": entry} if isinstance(entry, str) else entry
        built_in = next((MODELS / f"{kind.lower()}.xml" for kind in kinds if kind in BUILT_IN), None)
        file = (self.root / entry["model"]).resolve() if entry else built_in
        where = f"mjcf.{key or path}"
        name = path.rpartition("/")[2]
        if file is None:
            text = f"'{prim.prim_path}' has no model"
            text += f": rlcli does not load '{self.references[prim.prim_path]}'" if usd else ""
            place = user_location().removesuffix(": ") or where
            raise ConfigError([Problem(place, "", text, f"give an MJCF file: --model {name}=FILE.xml")])
        if not file.is_file():
            have = listing(sorted(str(p.relative_to(self.root)) for p in self.root.rglob("*.xml")))
            hint = f"MJCF files of the task: {have}" if have else f"--model {name}=FILE.xml"
            raise ConfigError([Problem(where, "", f"there is no file '{file}'", hint)])
        try:
            beside = [file.parent] if entry and Path(entry["model"]).is_absolute() else []
            roots = [*package_roots(self.root), home(self.root / "task.yaml"), MODELS, *beside]
            prim.child = read_mjcf(file, roots)
        except BadModel as error:
            raise ConfigError([Problem(where, "", f"'{file}' is not a valid MJCF; correct it: {error}")]) from None
        prim.label = str(entry.get("model", file.name))
        prim.names = {"joints": entry.get("joints", {}), "bodies": entry.get("bodies", {})}
        self._rename_elements(prim, where)

    def clone(self, source: Prim, path: str, pos: Any, quat: Any) -> None:
        """Add a copy of a prim with its model and settings; if the path exists, only the pose is set."""
        if path != source.prim_path:
            given = (getattr(source, name) if name in source.given else None for name in ("pos", "quat"))
            copy = self.define(path, *given)
            copy.child = None if source.child is None else source.child.copy()
            copy.label, copy.shape, copy._settings = source.label, source.shape, dict(source.settings)
        self.define(path, pos, quat)

    def attach(self, scene: Scene, joint_forces: bool) -> None:
        """Add every prim to the scene as an entity, with sensors of joint forces if a task reads them."""
        joints = [prim for prim in self.prims.values() if prim.kind.endswith("Joint")]
        has_drives = False
        # robots before shapes: the scene takes its options from its first model
        for prim in sorted(self.prims.values(), key=lambda prim: prim.shape):
            if prim.kind == "Mesh":
                add_terrain(scene, prim)
            if prim.child is None:
                continue
            has_drives |= apply_schemas(prim, scene.sim.dt)
            apply_settings(prim, prim.child)
            if joint_forces:
                add_force_sensors(prim.child)
            pose = {name: getattr(prim, name) for name in prim.given}
            entity = EntityConfig(model=prim.label, **pose)
            scene.attach(prim.entity, entity, prim.child)
        if has_drives:  # with Euler's method the armatures of drives make their steps implicit
            scene.spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
        for joint in joints:
            joint.kind = ""
            _add_joint(scene, joint)

    def note_ignored(self, what: str, reason: str, lost: bool = False) -> None:
        """Record a call without effect in MuJoCo, to log it later. `lost`: in PhysX the call changes the motion."""
        (self.lost if lost else self.ignored).setdefault(what, f"{user_location()}{reason}")

    def _rename_elements(self, prim: Prim, where: str) -> None:
        """Give joints and bodies the names that the task uses."""
        assert prim.child is not None
        kinds = {"joints": list(prim.child.joints), "bodies": list(prim.child.bodies)}
        for kind, names in prim.names.items():
            known = {element.name: element for element in kinds[kind]}
            for new, old in names.items():
                if old not in known:
                    near = did_you_mean(old, known) or f"{kind}: {listing(known)}"
                    raise ConfigError([Problem(f"{where}.{kind}.{new}", "", f"{prim.label} has no '{old}'", near)])
            for old, element in known.items():
                new_names = [new for new, was in names.items() if was == old]
                if new_names:
                    element.name = new_names[0]


def _add_joint(scene: Scene, prim: Prim) -> None:
    """Add a joint that a task has defined between a body and the world, as an equality constraint.

    Raises:
        TaskError: for any joint but one that locks all three translations of a body to a point of the world.
    """
    values = {name: attribute.value for (_, _, name), attribute in prim.attributes.items()}
    limits = {
        axis: (prim.attributes.get(("LimitAPI", axis, "Low")), prim.attributes.get(("LimitAPI", axis, "High")))
        for axis in ("transX", "transY", "transZ")
    }
    locked = all(low is not None and high is not None and low.value > high.value for low, high in limits.values())
    first, second = (values.get(name) or [] for name in ("Body0", "Body1"))
    target = prim.stage.GetPrimAtPath(second[0]) if len(second) == 1 else None
    world = len(first) == 1 and not prim.stage.GetPrimAtPath(first[0]).is_body()
    if not locked or not world or target is None or not target.is_body():
        raise TaskError(
            f"{values.get('where', '')}the joint '{prim.prim_path}' has no counterpart: only a joint that locks the"
            " three translations of a body to the ground has one",
            hint="add the constraint to the MJCF, as <equality>",
        )
    environment = prim.stage.GetPrimAtPath("/".join(prim.prim_path.split("/")[:4]))
    anchor = np.asarray(values.get("LocalPos0", (0.0, 0.0, 0.0))) - prim.stage.position(environment)
    name = prim.prim_path.removeprefix(f"{BASE}/").partition("/")[2]
    known = scene.spec.equality(name)
    if known is not None:
        site = scene.spec.site(f"{name}.anchor")
        if not np.allclose(site.pos, anchor, atol=1e-4):
            raise TaskError(f"the joint '{prim.prim_path}' must be at the same place as in the first environment")
        return
    body = scene.spec.body(f"{target.owner.entity}/{target.GetName()}")
    body.add_site(name=f"{name}.point", pos=np.asarray(values.get("LocalPos1", (0.0, 0.0, 0.0))), group=5)
    scene.spec.worldbody.add_site(name=f"{name}.anchor", pos=anchor, group=5)
    scene.spec.add_equality(
        name=name,
        type=mujoco.mjtEq.mjEQ_CONNECT,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        name1=f"{name}.point",
        name2=f"{name}.anchor",
    )


@contextlib.contextmanager
def current_stage(stage: Stage) -> Iterator[Stage]:
    """Make a stage the current one, on which robots and shapes are created."""
    _CURRENT_STAGES.append(stage)
    try:
        yield stage
    finally:
        _CURRENT_STAGES.remove(stage)


def get_current_stage(fabric: bool = False) -> Stage:
    """Return the stage of the task that is being built.

    Raises:
        TaskError: outside of `set_up_scene`.
    """
    if not _CURRENT_STAGES:
        hint = "create robots and shapes in the task's set_up_scene"
        raise TaskError(f"{user_location()}the task has no stage yet", hint=hint)
    return _CURRENT_STAGES[-1]


def note_ignored(what: str, reason: str, lost: bool = False) -> None:
    """Call `Stage.note_ignored` of the task that is being built; do nothing if no task is being built."""
    if _CURRENT_STAGES:
        _CURRENT_STAGES[-1].note_ignored(what, reason, lost)


def get_prim_at_path(prim_path: str, fabric: bool = False) -> Prim:
    """Return the prim at a path, or the prim whose model contains the path."""
    return get_current_stage().find(prim_path)


def is_prim_path_valid(prim_path: str, fabric: bool = False) -> bool:
    """Return whether there is a prim at a path."""
    return get_current_stage().GetPrimAtPath(prim_path).IsValid()


def find_matching_prim_paths(prim_path_regex: str) -> list[str]:
    """Return the paths of the prims that a regular expression matches, in the first environment."""
    pattern = path_pattern(prim_path_regex)
    return [path for path in get_current_stage().prims if pattern.fullmatch(path)]


def define_prim(prim_path: str, prim_type: str = "Xform", **kwargs: Any) -> Prim:
    """Add a prim without a model, such as a frame."""
    return get_current_stage().DefinePrim(prim_path, prim_type)


def add_reference_to_stage(usd_path: str, prim_path: str, prim_type: str = "Xform") -> Prim:
    """Record a prim's USD file, which is loaded when a robot or object is created at its path; return the prim."""
    stage = get_current_stage()
    stage.references[str(prim_path)] = str(usd_path)
    return Prim(stage, str(prim_path))


def get_assets_root_path(*args: Any, **kwargs: Any) -> str:
    """Return an empty text in place of the server that Isaac Sim's assets are on: nothing is downloaded."""
    return ""


def to_floats(value: Any, default: tuple[float, ...]) -> tuple[float, ...]:
    """Return a vector as a tuple of numbers; the default for None."""
    if value is None:
        return default
    if "torch" in sys.modules and hasattr(value, "detach"):
        value = value.detach().cpu().numpy()
    return tuple(float(x) for x in np.asarray(value, dtype=float).reshape(-1))


BUILT_IN = ("Cartpole", "Ant", "Humanoid", "Crazyflie", "Quadcopter", "Ingenuity")
"""Classes of robots with a built-in model."""

"""Randomisation of the model: every environment gets masses, friction, gains, ... of its own.

Every term draws anew from the value that the compiled model has, so that what was drawn before never adds up:
`operation: add` is original + draw, `scale` original x draw, `set` the draw itself. `range` is `[low, high]` of the
distributions uniform and loguniform, and `[mean, std]` of gaussian; a list of pairs gives one to each axis, and a
curriculum may move them. Axes are drawn each for itself, and so are the elements, unless `shared` gives all of
them one draw. What cannot be negative is kept from it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

import mujoco
import torch
from torch import Tensor

from rlcli.errors import listing
from rlcli.mdp.draws import Draw, Randomization, Turn
from rlcli.sim.model_fields import FIELDS, ModelField
from rlcli.sim.names import NameProblem, match
from rlcli.sim.scene_joints import actuator_kind
from rlcli.sim.selection import Columns, Selection
from rlcli.task import Actuators, Bodies, Entity, Geoms, Joints, Pairs, Sites, Tendons

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv

_SMALLEST = 1e-9
"""What must be positive is at least this."""


class RandomizeBodyMass(Randomization):
    """Masses of bodies [kg]; their inertias are scaled alike, unless `with_inertia` is false."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        bodies: Bodies = ".*",
        range: tuple[float, float],
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "scale",
        shared: bool = False,
        with_inertia: bool = True,
    ) -> None:
        super().__init__(env, entity, "body_mass", bodies, range, distribution, operation, shared, lowest=_SMALLEST)
        massless = (self.field.original[:, 0] == 0).tolist()
        if with_inertia and any(massless):
            names = [name for name, none in zip(_named(entity, "Bodies", bodies), massless, strict=True) if none]
            raise NameProblem(f"no mass to change on {listing(names)}", "choose other bodies, or with_inertia: false")
        self._inertia = ModelField(entity, "body_inertia", bodies) if with_inertia else None

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        mass = self.draw(selection, self.field.original)
        self.field.write(selection, mass)
        if self._inertia is not None:
            self._inertia.write(selection, self._inertia.original * (mass / self.field.original))


class RandomizeBodyCom(Randomization):
    """Centres of mass of bodies, in the body's frame [m]."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        bodies: Bodies = ".*",
        axes: list[int] | None = None,
        range: tuple[float, float] | list[tuple[float, float]],
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "add",
        shared: bool = False,
    ) -> None:
        super().__init__(env, entity, "body_ipos", bodies, range, distribution, operation, shared, axes)

    @staticmethod
    def prepare(spec: mujoco.MjSpec, params: dict[str, Any]) -> None:
        """Have MuJoCo compile the bodies as ones whose mass may lie anywhere."""
        for body in _chosen(spec.bodies, params, "bodies", "body"):
            body.simple = 0


class RandomizeBodyInertia(Randomization):
    """Principal moments of inertia of bodies [kg m^2], the three of a body by one factor."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        bodies: Bodies = ".*",
        range: tuple[float, float],
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        shared: bool = False,
    ) -> None:
        field, scale = "body_inertia", "scale"
        super().__init__(env, entity, field, bodies, range, distribution, scale, shared, lowest=_SMALLEST, alike=True)


class RandomizeBodyPos(Randomization):
    """Positions of bodies, in the frame of their parent [m]; a floating root's is its reset's."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        bodies: Bodies = ".*",
        axes: list[int] | None = None,
        range: tuple[float, float] | list[tuple[float, float]],
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "add",
        shared: bool = False,
    ) -> None:
        super().__init__(env, entity, "body_pos", bodies, range, distribution, operation, shared, axes)


class RandomizeBodyQuat(Turn):
    """Orientations of bodies, turned about their own axes by roll, pitch and yaw [rad]."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        bodies: Bodies = ".*",
        roll: tuple[float, float] = (0.0, 0.0),
        pitch: tuple[float, float] = (0.0, 0.0),
        yaw: tuple[float, float] = (0.0, 0.0),
        distribution: Literal["uniform", "gaussian"] = "uniform",
        shared: bool = False,
    ) -> None:
        super().__init__(env, entity, "body_quat", bodies, [roll, pitch, yaw], distribution, shared)


class RandomizeGeomFriction(Randomization):
    """Friction of geoms: axis 0 slides, 1 spins [m], 2 rolls [m]; it prevails over that of what they touch.

    MuJoCo takes the larger friction of two geoms of equal priority, so that a lower one would change nothing: the
    chosen geoms get a higher priority than all others, unless `prevail` is false. With it their `condim`, `solref` and
    `solimp` hold, too.
    """

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        geoms: Geoms = ".*",
        axes: list[int] = [0],  # noqa: B006 (read, never written)
        range: tuple[float, float] | list[tuple[float, float]],
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "scale",
        shared: bool = False,
        prevail: bool = True,
    ) -> None:
        field = "geom_friction"
        super().__init__(env, entity, field, geoms, range, distribution, operation, shared, axes, lowest=0.0)

    @staticmethod
    def prepare(spec: mujoco.MjSpec, params: dict[str, Any]) -> None:
        """Raise the priority of the chosen geoms."""
        if params["prevail"]:
            chosen = _chosen(spec.geoms, params, "geoms", "geom")
            names = {geom.name for geom in chosen}
            others = max((int(geom.priority) for geom in spec.geoms if geom.name not in names), default=0)
            for geom in chosen:
                geom.priority = max(int(geom.priority), others + 1)


class RandomizeGeomSize(Randomization):
    """Sizes of geoms [m], the values of a geom by one draw; meshes, height fields and planes have none."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        geoms: Geoms = ".*",
        axes: list[int] | None = None,
        range: tuple[float, float] | list[tuple[float, float]],
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "scale",
        shared: bool = False,
    ) -> None:
        _require_sized(entity, geoms)
        super().__init__(
            env, entity, "geom_size", geoms, range, distribution, operation, shared, axes, lowest=_SMALLEST, alike=True
        )


class RandomizeGeomPos(Randomization):
    """Positions of geoms, in the frame of the body they belong to [m]."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        geoms: Geoms = ".*",
        axes: list[int] | None = None,
        range: tuple[float, float] | list[tuple[float, float]],
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "add",
        shared: bool = False,
    ) -> None:
        super().__init__(env, entity, "geom_pos", geoms, range, distribution, operation, shared, axes)


class RandomizeGeomQuat(Turn):
    """Orientations of geoms, turned about their own axes by roll, pitch and yaw [rad]."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        geoms: Geoms = ".*",
        roll: tuple[float, float] = (0.0, 0.0),
        pitch: tuple[float, float] = (0.0, 0.0),
        yaw: tuple[float, float] = (0.0, 0.0),
        distribution: Literal["uniform", "gaussian"] = "uniform",
        shared: bool = False,
    ) -> None:
        super().__init__(env, entity, "geom_quat", geoms, [roll, pitch, yaw], distribution, shared)


class RandomizeSitePos(Randomization):
    """Positions of sites, in the frame of the body they belong to [m]."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        sites: Sites = ".*",
        axes: list[int] | None = None,
        range: tuple[float, float] | list[tuple[float, float]],
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "add",
        shared: bool = False,
    ) -> None:
        super().__init__(env, entity, "site_pos", sites, range, distribution, operation, shared, axes)


class RandomizeSiteQuat(Turn):
    """Orientations of sites, turned about their own axes by roll, pitch and yaw [rad]."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        sites: Sites = ".*",
        roll: tuple[float, float] = (0.0, 0.0),
        pitch: tuple[float, float] = (0.0, 0.0),
        yaw: tuple[float, float] = (0.0, 0.0),
        distribution: Literal["uniform", "gaussian"] = "uniform",
        shared: bool = False,
    ) -> None:
        super().__init__(env, entity, "site_quat", sites, [roll, pitch, yaw], distribution, shared)


class _JointNumber(Randomization):
    """A number of each joint that cannot be negative."""

    number: ClassVar[str]
    """The model's field."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints = ".*",
        range: tuple[float, float],
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "scale",
        shared: bool = False,
    ) -> None:
        super().__init__(env, entity, self.number, joints, range, distribution, operation, shared, lowest=0.0)


class RandomizeJointDamping(_JointNumber):
    """Viscous damping of joints [N s/m or N m s/rad]."""

    number = "dof_damping"


class RandomizeJointArmature(_JointNumber):
    """Rotor inertia of joints [kg or kg m^2]."""

    number = "dof_armature"


class RandomizeJointFrictionLoss(_JointNumber):
    """Dry friction of joints [N or N m]."""

    number = "dof_frictionloss"


class RandomizeJointStiffness(_JointNumber):
    """Spring stiffness of joints [N/m or N m/rad]."""

    number = "jnt_stiffness"


class RandomizeJointRange:
    """Position limits of joints [m or rad]; what reads the limits follows."""

    derives = False

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints = ".*",
        lower: tuple[float, float] | None = None,
        upper: tuple[float, float] | None = None,
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "add",
        shared: bool = False,
    ) -> None:
        limited = env.engine.model.jnt_limited[entity.joint_ids].astype(bool).tolist()
        _require(entity, "Joints", joints, limited, "has no limits", "give it a range in scene.entities")
        self._field = ModelField(entity, "jnt_range", joints)
        shape = (self._field.shape[0], 1)
        self._draws = [
            None if pair is None else Draw(env, pair, distribution, operation, shape, shared=shared)
            for pair in (lower, upper)
        ]

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        now = self._field.read(selection)
        low, high = (
            now[:, :, end : end + 1] if draw is None else draw(selection, self._field.original[:, end : end + 1])
            for end, draw in enumerate(self._draws)
        )
        self._field.write(selection, torch.cat([torch.minimum(low, high), torch.maximum(low, high)], dim=2))


class RandomizeDefaultJointPos:
    """Default joint positions [m or rad], about which resets, actions and observations are: as if encoders were off."""

    derives = False

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints = ".*",
        range: tuple[float, float],
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "add",
        shared: bool = False,
    ) -> None:
        self._default = entity.data.default_joint_pos
        self._joints = joints
        self._original = self._default[0, joints].clone()[:, None]
        shape = (len(self._original), 1)
        self._draw = Draw(env, range, distribution, operation, shape, shared=shared)

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        selection.write(self._default, self._draw(selection, self._original)[:, :, 0], self._joints)

    def state_dict(self) -> dict[str, Tensor]:
        """The default positions of all environments."""
        return {"default": self._default.clone()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Take back what `state_dict` gave."""
        self._default.copy_(state["default"])


class RandomizeActuatorGains:
    """Gains of MuJoCo's own actuators: kp of position [N/m or N m/rad], kv of position and velocity ones [x s]."""

    derives = False

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        actuators: Actuators = ".*",
        kp: tuple[float, float] | None = None,
        kv: tuple[float, float] | None = None,
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "scale",
        shared: bool = False,
    ) -> None:
        if kp is None and kv is None:
            raise NameProblem("nothing to randomise", "give kp, kv or both")
        kinds = _kinds(entity)
        can_kp = [kind == "position" for kind in kinds]
        can_kv = [kind in ("position", "velocity") for kind in kinds]
        if kp is not None:
            _require(entity, "Actuators", actuators, can_kp, "has no kp", "kp is a position actuator's")
        if kv is not None:
            _require(entity, "Actuators", actuators, can_kv, "has no kv", "kv is a position or velocity actuator's")
        self._gain = ModelField(entity, "actuator_gainprm", actuators, [0])
        self._bias = ModelField(entity, "actuator_biasprm", actuators, [1, 2])
        is_position = torch.tensor(can_kp)[actuators.cpu() if isinstance(actuators, Tensor) else actuators]
        self._is_position = is_position[:, None].to(env.device)
        shape = (self._gain.shape[0], 1)
        self._kp, self._kv = (
            None if pair is None else Draw(env, pair, distribution, operation, shape, shared=shared, lowest=0.0)
            for pair in (kp, kv)
        )

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        bias = self._bias.read(selection)
        stiffness, damping = -bias[:, :, :1], -bias[:, :, 1:]
        if self._kp is not None:
            stiffness = self._kp(selection, -self._bias.original[:, :1]).to(bias.dtype)
        if self._kv is not None:
            damping = self._kv(selection, -self._bias.original[:, 1:]).to(bias.dtype)
        self._gain.write(selection, torch.where(self._is_position, stiffness, damping))
        self._bias.write(selection, torch.cat([-stiffness, -damping], dim=2))


class RandomizePdGains:
    """Actuator models (`scene.entities.*.actuators`): stiffness, damping [x s], effort limit [N or N m] of joints."""

    derives = False

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        joints: Joints = ".*",
        stiffness: tuple[float, float] | None = None,
        damping: tuple[float, float] | None = None,
        effort_limit: tuple[float, float] | None = None,
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "scale",
        shared: bool = False,
    ) -> None:
        pairs = {"stiffness": stiffness, "damping": damping, "effort_limit": effort_limit}
        if not any(pair is not None for pair in pairs.values()):
            raise NameProblem("nothing to randomise", "give stiffness, damping, effort_limit or several")
        driven = {joint: (model, place) for model in entity.actuators for place, joint in enumerate(model.joints)}
        good = [joint in driven for joint in range(len(entity.joint_names))]
        _require(entity, "Joints", joints, good, "has no actuator model", "randomize_actuator_gains has MuJoCo's own")
        chosen = torch.arange(len(good))[joints.cpu() if isinstance(joints, Tensor) else joints].tolist()
        self._parts = [(*driven[joint], number) for number, joint in enumerate(chosen)]
        self._draws = []
        for name, pair in pairs.items():
            if pair is not None:
                own = [getattr(model, name)[0, place] for model, place, _ in self._parts]
                draw = Draw(env, pair, distribution, operation, (len(chosen), 1), shared=shared, lowest=0.0)
                self._draws.append((name, torch.stack(own)[:, None], draw))

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        for name, original, draw in self._draws:
            values = draw(selection, original)
            for model, place, number in self._parts:
                selection.write(getattr(model, name), values[:, number], slice(place, place + 1))


class RandomizeEffortLimit:
    """Largest force of MuJoCo's own actuators on their joints, to both sides [N or N m]."""

    derives = False

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        actuators: Actuators = ".*",
        range: tuple[float, float],
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "scale",
        shared: bool = False,
    ) -> None:
        limited = env.engine.model.actuator_forcelimited[entity.actuator_ids].astype(bool).tolist()
        _require(entity, "Actuators", actuators, limited, "has no effort limit", "give its joint an effort_limit")
        self._field = ModelField(entity, "actuator_forcerange", actuators)
        gear = env.engine.model.actuator_gear[entity.actuator_ids, 0]
        chosen = torch.as_tensor(gear).abs()[actuators.cpu() if isinstance(actuators, Tensor) else actuators]
        self._gear = torch.where(chosen > 0, chosen, 1.0)[:, None].to(env.device, self._field.original.dtype)
        self._effort = self._field.original[:, 1:] * self._gear
        shape = (self._field.shape[0], 1)
        self._draw = Draw(env, range, distribution, operation, shape, shared=shared, lowest=0.0)

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        force = self._draw(selection, self._effort) / self._gear
        self._field.write(selection, torch.cat([-force, force], dim=2))


class RandomizeGravity(Randomization):
    """Gravity, world frame [m/s^2]; the direction that observations see follows."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        axes: list[int] = [2],  # noqa: B006 (read, never written)
        range: tuple[float, float] | list[tuple[float, float]],
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "add",
    ) -> None:
        entity = next(iter(env.entities.values()))
        super().__init__(env, entity, "opt.gravity", None, range, distribution, operation, axes=axes)


class _TendonNumber(Randomization):
    """A number of each tendon that cannot be negative."""

    number: ClassVar[str]
    """The model's field."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        tendons: Tendons = ".*",
        range: tuple[float, float],
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "scale",
        shared: bool = False,
    ) -> None:
        super().__init__(env, entity, self.number, tendons, range, distribution, operation, shared, lowest=0.0)


class RandomizeTendonStiffness(_TendonNumber):
    """Stiffness of tendons [N/m]."""

    number = "tendon_stiffness"


class RandomizeTendonDamping(_TendonNumber):
    """Damping of tendons [N s/m]."""

    number = "tendon_damping"


class RandomizeTendonFrictionLoss(_TendonNumber):
    """Dry friction of tendons [N]."""

    number = "tendon_frictionloss"


class RandomizeTendonArmature(_TendonNumber):
    """Armature of tendons [kg]."""

    number = "tendon_armature"


class RandomizePairFriction(Randomization):
    """Friction of contact pairs that the MJCF names: axes 0 and 1 slide, 2 spins [m], 3 and 4 roll [m]."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        pairs: Pairs = ".*",
        axes: list[int] = [0, 1],  # noqa: B006 (read, never written)
        range: tuple[float, float] | list[tuple[float, float]],
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "scale",
        shared: bool = False,
    ) -> None:
        super().__init__(env, entity, "pair_friction", pairs, range, distribution, operation, shared, axes, lowest=0.0)


class RandomizeModelField(Randomization):
    """Any number of the model that may differ between environments, by its name in MuJoCo's MjModel."""

    def __init__(
        self,
        env: ManagedEnv,
        *,
        entity: Entity = "robot",
        field: str,
        names: str | list[str] = ".*",
        axes: list[int] | None = None,
        range: tuple[float, float] | list[tuple[float, float]],
        distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform",
        operation: Literal["add", "scale", "set"] = "scale",
        shared: bool = False,
    ) -> None:
        kind = FIELDS.get(field)
        elements = entity.select(kind, names)[0] if kind else None
        super().__init__(env, entity, field, elements, range, distribution, operation, shared, axes)

    @staticmethod
    def prepare(spec: mujoco.MjSpec, params: dict[str, Any]) -> None:
        """Have MuJoCo compile bodies whose mass is moved or turned as ones where it may lie anyhow."""
        if params["field"] in ("body_ipos", "body_iquat"):
            for body in _chosen(spec.bodies, params, "names", "body"):
                body.simple = 0


def _chosen(elements: list[Any], params: dict[str, Any], key: str, what: str) -> list[Any]:
    """Elements of the scene that a term's patterns match; what does not match is told when the term is bound."""
    prefix = f"{params['entity']}/"
    of_entity = [element for element in elements if element.name.startswith(prefix)]
    try:
        found = match(params[key], [element.name.removeprefix(prefix) for element in of_entity], what)
    except NameProblem:
        return []
    return [of_entity[position] for position in found]


def _named(entity: Any, kind: str, index: Columns) -> list[str]:
    names = entity.names[kind]
    return [names[i] for i in torch.arange(len(names))[index.cpu() if isinstance(index, Tensor) else index].tolist()]


def _require(entity: Any, kind: str, index: Columns, good: list[bool], problem: str, hint: str) -> None:
    """Every chosen element must be good for what is asked of it.

    Raises:
        NameProblem: naming those that are not.
    """
    able = dict(zip(entity.names[kind], good, strict=True))
    bad = [name for name in _named(entity, kind, index) if not able[name]]
    if bad:
        can = [name for name, fine in able.items() if fine]
        raise NameProblem(f"{listing(bad)} {problem}", f"{hint}; of '{entity.name}' these do: {listing(can) or 'none'}")


def _require_sized(entity: Any, geoms: Columns) -> None:
    shapeless = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD, mujoco.mjtGeom.mjGEOM_MESH)
    types = entity.engine.model.geom_type[entity.geom_ids]
    good = [int(kind) not in map(int, shapeless) for kind in types]
    _require(entity, "Geoms", geoms, good, "cannot change its size", "boxes, spheres, capsules, ... can")


def _kinds(entity: Any) -> list[str]:
    model = entity.engine.model
    return [
        actuator_kind(
            model.actuator_trntype[a],
            model.actuator_dyntype[a],
            model.actuator_gaintype[a],
            model.actuator_biastype[a],
            model.actuator_gainprm[a],
            model.actuator_biasprm[a],
        )
        for a in entity.actuator_ids.tolist()
    ]

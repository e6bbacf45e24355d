"""Schema of the section `scene`: ground, lights, robots and objects with their joints and actuators.

`rlcli.scene` builds a MuJoCo model from these settings.
"""

from typing import Annotated, Literal, Self

from pydantic import Field, ValidationInfo, field_validator, model_validator
from pydantic_core import PydanticKnownError

from rlcli.config.schema.base import (
    Names,
    NotNegative,
    Number,
    Positive,
    Quaternion,
    Range,
    StepRange,
    StrictModel,
    Vec3,
    _FractionString,
)
from rlcli.config.schema.sensors import SensorConfig
from rlcli.config.schema.terrain import TerrainConfig

_Channel = Annotated[float, Field(ge=0, le=1)]
Color = tuple[_Channel, _Channel, _Channel]
"""Red, green, blue in [0, 1]."""


class GroundConfig(StrictModel):
    """A ground plane."""

    size: Positive = 100.0
    """Edge length of the plane [m]."""
    height: Number = 0.0
    """Height of the plane [m], z in the world frame."""
    friction: NotNegative = 1.0
    """Coefficient of sliding friction."""


class DomeLightConfig(StrictModel):
    """Ambient light from all directions."""

    color: Color = (0.9, 0.9, 0.9)
    """Colour of the light: red, green, blue in [0, 1]."""
    intensity: NotNegative = 500.0
    """Strength, from 0 to 1000; a larger number has no further effect. At 1000 a white surface is fully white."""


class DistantLightConfig(DomeLightConfig):
    """Parallel light from one direction, with shadows."""

    direction: Vec3 = (0.3, 0.2, -1.0)
    """Direction in which the light travels, world frame; its length does not matter."""


class LightsConfig(StrictModel):
    """Lights of the scene."""

    dome: DomeLightConfig | None = None
    """Ambient light; null: none."""
    distant: DistantLightConfig | None = None
    """Parallel light, like sunlight; null: none."""


class JointConfig(StrictModel):
    """New values for the joints of an entity. null keeps the value of the MJCF."""

    damping: NotNegative | None = None
    """Viscous damping [N s/m or N m s/rad]."""
    stiffness: NotNegative | None = None
    """Spring stiffness [N/m or N m/rad]."""
    armature: NotNegative | None = None
    """Rotor inertia added to the joint [kg or kg m^2]."""
    friction_loss: NotNegative | None = None
    """Dry friction [N or N m]."""
    range: Range | None = None
    """[low, high] position limits [m or rad]."""
    effort_limit: Positive | None = None
    """Largest force or torque of the joint's actuator [N or N m]."""
    velocity_limit: Positive | None = None
    """Speed limit that terms read [m/s or rad/s]; the physics does not enforce it. null: the `velocity_limit` of the
    joint's dc_motor."""
    actuator: Literal["motor", "position", "velocity"] | None = None
    """Actuator to add if the MJCF has none of this kind. Action terms add the actuators that they need by
    themselves."""
    kp: Positive | None = None
    """Gain of a position actuator [N/m or N m/rad]."""
    kv: NotNegative | None = None
    """Gain of a velocity actuator, or damping of a position actuator [N s/m or N m s/rad]."""


ByJoint = NotNegative | dict[str, NotNegative]
"""One number for all joints, or a mapping from names or regexes of joints to numbers, in which every joint must match
exactly one key."""


class ActuatorConfig(StrictModel):
    """An actuator model, computed before every physics step. It replaces the MJCF's actuators of its joints."""

    joints: Names
    """Joints that the actuator drives: names or regexes, in this order."""
    kind: Literal["pd", "dc_motor"] = "pd"
    """pd: a PD controller with an effort limit; dc_motor: a PD controller of a motor with a torque-speed curve."""
    stiffness: ByJoint = 0.0
    """Gain on the position error [N/m or N m/rad]: one number for all joints, or a mapping from names or regexes of
    joints to numbers, in which every joint must match exactly one key."""
    damping: ByJoint = 0.0
    """Gain on the velocity error [N s/m or N m s/rad]: one number, or a mapping as in `stiffness`."""
    effort_limit: ByJoint | None = None
    """Largest force or torque [N or N m]: one number, or a mapping as in `stiffness`; null: no limit."""
    saturation_effort: Positive | None = None
    """Stall force or torque of a dc_motor [N or N m]."""
    velocity_limit: Positive | dict[str, Positive] | None = None
    """No-load speed of a dc_motor [m/s or rad/s]: one number for all joints, or a mapping as in `stiffness`. Terms read
    it as the speed limit of joints whose own `velocity_limit` is null."""
    delay: StepRange = (0, 0)
    """[low, high] physics steps until a command takes effect, both included. One number is drawn for each environment
    at the start of an episode."""

    @model_validator(mode="after")
    def _motor(self) -> Self:
        curve = (self.saturation_effort is not None, self.velocity_limit is not None)
        if self.kind == "dc_motor" and not all(curve):
            raise ValueError("kind dc_motor needs saturation_effort and velocity_limit: set both")
        if self.kind == "pd" and any(curve):
            raise ValueError(
                "saturation_effort and velocity_limit are allowed only with kind: dc_motor; set it, or remove them"
            )
        return self


class InitialStateConfig(StrictModel):
    """Default state of an entity, the basis of resets. Its pose is the entity's `pos` and `quat`."""

    joint_pos: dict[str, Number] = {}
    """Joint name or regex -> default position [m or rad]."""
    joint_vel: dict[str, Number] = {}
    """Joint name or regex -> default velocity [m/s or rad/s]."""
    lin_vel: Vec3 = (0.0, 0.0, 0.0)
    """Linear velocity of a free root body, world frame [m/s]: of its origin or centre of mass, see `velocity_point`."""
    ang_vel: Vec3 = (0.0, 0.0, 0.0)
    """Angular velocity of a free root body, world frame [rad/s]."""


SHAPE_SIZES = {
    "box": "[x, y, z], the lengths of its edges",
    "sphere": "[radius]",
    "cylinder": "[radius, length]",
    "capsule": "[radius, length], the length without the round ends",
    "cone": "[radius, length]",
    "plane": "[x, y], the lengths of its edges",
}
"""Shape -> meaning of its `size` [m]."""


_SHAPE_KEYS = ("size", "axis", "mass", "density", "free", "mocap", "collides")


class EntityConfig(StrictModel):
    """A robot or object: an MJCF file that is attached to the scene under the entity's name, or a single shape."""

    model: str | None = None
    """MJCF file, relative to the task's folder. `TASK:FILE` is a file of an installed task, for example
    `cartpole:cartpole.xml`; `package:PACKAGE/FILE` a file of any installed Python package; `models:FILE` a file in a
    folder that the environment variable RLCLI_MODELS lists. ` | ` separates alternatives; the first existing one is
    used."""
    shape: Literal["box", "sphere", "cylinder", "capsule", "cone", "plane"] | None = None
    """Shape to use instead of a model: a body named `body` with one geom named `geom`. A cone is a mesh with 32 edges
    and the volume of the cone; its origin is at half its length, and its tip points along `axis`."""
    size: list[Positive] | None = None
    """Size of a shape [m]: edges [x, y, z] of a box and [x, y] of a plane; [radius] of a sphere; [radius, length] of a
    cylinder, capsule or cone."""
    axis: Literal["x", "y", "z"] = "z"
    """Axis of a cylinder, capsule or cone in the frame of its body."""
    collides: bool = True
    """false: the shape is seen by cameras and rays, but touches nothing."""
    free: bool = False
    """true: the shape moves freely; false: it is fixed at `pos`."""
    mocap: bool = False
    """true: the shape is not moved by physics, but events may move it."""
    mass: Positive | None = None
    """Mass of a shape [kg]; null: computed from its density."""
    density: Positive | None = None
    """Density of a shape [kg/m^3]; null: 1000."""
    friction: NotNegative = 1.0
    """Coefficient of sliding friction of a shape."""
    color: Color = (0.55, 0.6, 0.65)
    """Colour of a shape: red, green, blue in [0, 1]."""
    pos: Vec3 | None = None
    """Start position of the root in the environment's frame [m]; null: that in the MJCF, and 0 for a shape. The root is
    the first body of the MJCF, or the shape. A root that can move starts there, any other root is fixed there; the rest
    of the MJCF moves with the root. Events that reset the root use this pose. Keyframes of the MJCF are not read."""
    quat: Quaternion | None = None
    """Start orientation of the root (w, x, y, z) in the environment's frame, which is normalised; null: that in the
    MJCF."""
    velocity_point: Literal["origin", "com"] = "origin"
    """Point of a body whose linear velocity and acceleration are read by terms, given in `init` and set by events: the
    origin of the body's frame, or its centre of mass (com), as in Isaac Lab."""
    gravity: bool = True
    """false: gravity does not act on the bodies, as with MuJoCo's `gravcomp="1"`."""
    joints: dict[str, JointConfig] = {}
    """Joint name or regex -> changes of the joint. If several match a joint, the later one wins key by key."""
    actuators: dict[str, ActuatorConfig] = {}
    """Name -> actuator model. Joints without an actuator model keep the actuators of the MJCF."""
    init: InitialStateConfig = InitialStateConfig()
    """Default state. A joint that is not listed starts at the MJCF's qpos0 with velocity 0."""
    soft_joint_pos_limit_factor: Annotated[float, Field(gt=0, le=100), _FractionString()] = 1.0
    """Factor from the joint range to the range of the soft limits, around the same middle. Terms read the soft limits;
    the physics does not enforce them."""

    @model_validator(mode="after")
    def _one_kind(self, info: ValidationInfo) -> Self:
        if (self.model or "").startswith("file:") and not (info.context or {}).get("given_models"):
            raise ValueError(f"'{self.model}' lies outside the task's folder; move the file into this folder")
        if (self.model is None) == (self.shape is None):
            raise ValueError("an entity has either `model` (an MJCF file) or `shape`: write one of the two")
        if self.shape is not None:
            self._check_shape(self.shape)
        elif keys := [key for key in _SHAPE_KEYS if getattr(self, key) != type(self).model_fields[key].default]:
            raise ValueError(f"'{keys[0]}' is only allowed with `shape`; remove it and set it in the MJCF of the model")
        return self

    def _check_shape(self, shape: str) -> None:
        wanted = SHAPE_SIZES[shape]
        count = wanted.partition("]")[0].count(",") + 1
        if self.size is None or len(self.size) != count:
            found = "none" if self.size is None else f"{len(self.size)} numbers"
            raise ValueError(f"size of a {shape} must be {wanted} [m]; found {found}")
        if self.mass is not None and self.density is not None:
            raise ValueError("mass and density cannot be combined: remove one")
        if self.axis != "z" and shape not in ("cylinder", "capsule", "cone"):
            raise ValueError(f"a {shape} has no axis: remove axis, or turn the {shape} with quat")
        if self.free and self.mocap:
            raise ValueError("free and mocap cannot be combined: remove one")
        if shape == "plane" and (self.free or self.mocap):
            raise ValueError("a plane cannot move: remove free and mocap, or use `shape: box`")


_MAX_ENTITIES = 500


class SceneConfig(StrictModel):
    """The scene that each environment simulates."""

    num_envs: Annotated[int, Field(ge=1, le=1 << 24)] = 1024
    """Number of environments that are simulated in parallel."""
    workers: Annotated[int, Field(ge=1, le=1024)] | Literal["auto"] = "auto"
    """Number of processes that step the environments of a training on a CPU. Results do not depend on this number.
    auto: chosen by the number of environments, the cores and the free memory; 1 for a task with cameras, and for a task
    of your own with Python code."""
    env_spacing: NotNegative = 4.0
    """Distance between environments in viewers [m]. In the physics each environment is a world with its own origin."""
    ground: GroundConfig | None = GroundConfig()
    """Ground plane; null: none. A terrain replaces it."""
    terrain: TerrainConfig | None = None
    """Uneven ground. All environments share one terrain and start at different positions on it."""
    lights: LightsConfig = LightsConfig(dome=DomeLightConfig())
    """Lights of the scene: ambient light from all directions, and parallel light."""
    entities: dict[str, EntityConfig] = Field(json_schema_extra={"minProperties": 1, "maxProperties": _MAX_ENTITIES})
    """Name -> robot or object; at most 500."""
    sensors: dict[str, SensorConfig] = {}
    """Name -> contact sensor, ray sensor or camera that terms use. Sensors of the MJCF need no entry."""

    @field_validator("entities")
    @classmethod
    def _has_right_size(cls, value: dict[str, EntityConfig], info: ValidationInfo) -> dict[str, EntityConfig]:
        if not value and not (info.context or {}).get("open_scene"):
            raise PydanticKnownError("too_short", {"field_type": "Dictionary", "min_length": 1, "actual_length": 0})
        if len(value) > _MAX_ENTITIES:  # the time to attach an entity grows with the square of their number
            raise ValueError(f"{len(value)} entities are too many; at most {_MAX_ENTITIES} are allowed")
        return value

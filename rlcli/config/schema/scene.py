"""The scene: ground, lights, robots and objects, with their joints and actuators."""

from __future__ import annotations

from typing import Annotated, Literal

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
    """A ground plane at z = 0."""

    size: Positive = 100.0
    """Edge length [m]."""
    friction: NotNegative = 1.0
    """Sliding friction."""


class DomeLightConfig(StrictModel):
    """Light from everywhere."""

    color: Color = (0.9, 0.9, 0.9)
    """Red, green, blue in [0, 1]."""
    intensity: NotNegative = 500.0
    """Strength; 1000 is full white on a white surface."""


class DistantLightConfig(DomeLightConfig):
    """Parallel light from one direction, with shadows."""

    direction: Vec3 = (0.3, 0.2, -1.0)
    """Direction the light travels, world frame."""


class LightsConfig(StrictModel):
    """The lights of the scene."""

    dome: DomeLightConfig | None = None
    """Ambient light."""
    distant: DistantLightConfig | None = None
    """Sun-like light."""


class JointConfig(StrictModel):
    """What a task changes on joints of an entity; null keeps what the MJCF says."""

    damping: NotNegative | None = None
    """Viscous damping [N s/m or N m s/rad]."""
    stiffness: NotNegative | None = None
    """Spring stiffness [N/m or N m/rad]."""
    armature: NotNegative | None = None
    """Rotor inertia [kg or kg m^2]."""
    friction_loss: NotNegative | None = None
    """Dry friction [N or N m]."""
    range: Range | None = None
    """Position limits [m or rad]."""
    effort_limit: Positive | None = None
    """Largest force of the joint's actuator [N or N m]."""
    velocity_limit: Positive | None = None
    """Speed that terms judge by [m/s or rad/s]; the physics does not enforce it."""
    actuator: Literal["motor", "position", "velocity"] | None = None
    """Actuator to add where the MJCF has none of this kind; an action term adds what it needs by itself."""
    kp: Positive | None = None
    """Gain of a position actuator [N/m or N m/rad]."""
    kv: NotNegative | None = None
    """Gain of a velocity actuator, or damping of a position actuator [N s/m or N m s/rad]."""


ByJoint = NotNegative | dict[str, NotNegative]
"""One number for all joints, or name or regex -> number, which must name every joint once."""


class ActuatorConfig(StrictModel):
    """A model of what drives joints, in place of the MJCF's actuators; it is computed before every physics step."""

    joints: Names
    """Joints that it drives: names or regexes, in this order."""
    kind: Literal["pd", "dc_motor"] = "pd"
    """pd: a PD controller with an effort limit; dc_motor: one behind a motor with a torque-speed curve."""
    stiffness: ByJoint = 0.0
    """Gain on the position error [N/m or N m/rad]."""
    damping: ByJoint = 0.0
    """Gain on the velocity error [N s/m or N m s/rad]."""
    effort_limit: ByJoint | None = None
    """Largest effort [N or N m]; null: none."""
    saturation_effort: Positive | None = None
    """Stall torque of a dc_motor [N or N m]."""
    velocity_limit: Positive | None = None
    """No-load speed of a dc_motor [m/s or rad/s]."""
    delay: StepRange = (0, 0)
    """[low, high] physics steps until a command arrives, ends included, drawn an environment at an episode's start."""

    @model_validator(mode="after")
    def _motor(self) -> ActuatorConfig:
        curve = (self.saturation_effort is not None, self.velocity_limit is not None)
        if self.kind == "dc_motor" and not all(curve):
            raise ValueError("a dc_motor needs saturation_effort and velocity_limit")
        if self.kind == "pd" and any(curve):
            raise ValueError("saturation_effort and velocity_limit belong to kind dc_motor")
        return self


class InitialStateConfig(StrictModel):
    """The default state of an entity, which resets start from; its pose is the entity's `pos` and `quat`."""

    joint_pos: dict[str, Number] = {}
    """Joint name or regex -> position [m or rad]."""
    joint_vel: dict[str, Number] = {}
    """Joint name or regex -> velocity [m/s or rad/s]."""
    lin_vel: Vec3 = (0.0, 0.0, 0.0)
    """Velocity of a free root, world frame [m/s]."""
    ang_vel: Vec3 = (0.0, 0.0, 0.0)
    """Angular velocity of a free root, world frame [rad/s]."""


SHAPE_SIZES = {
    "box": "[x, y, z], its edges",
    "sphere": "[radius]",
    "cylinder": "[radius, length]",
    "capsule": "[radius, length], the length without the round ends",
    "plane": "[x, y], its edges",
}
"""Shape -> what its `size` holds [m]."""


class EntityConfig(StrictModel):
    """A robot or object: an MJCF file attached to the scene under the entity's name, or a single shape."""

    model: str | None = None
    """MJCF file, relative to the task's folder; `TASK:FILE` is one of an installed task, as
    `cartpole:cartpole.xml`; `package:PACKAGE/FILE` one in any installed Python package; `models:FILE` one in a folder
    of the user's that the environment variable RLCLI_MODELS names. Of several with ` | ` between them the first that is
    there."""
    shape: Literal["box", "sphere", "cylinder", "capsule", "plane"] | None = None
    """Instead of a model: a body `body` with one geom `geom`."""
    size: list[Positive] | None = None
    """Of a shape [m]: box [x, y, z] and plane [x, y] edges; sphere [radius]; cylinder and capsule [radius, length]."""
    free: bool = False
    """A shape: it moves freely; false: it stands where `pos` has put it."""
    mocap: bool = False
    """A shape: it stands still, and events may move it."""
    mass: Positive | None = None
    """Mass of a shape [kg]; null: its density decides."""
    density: Positive | None = None
    """Density of a shape [kg/m^3]; null: 1000."""
    friction: NotNegative = 1.0
    """Sliding friction of a shape."""
    color: Color = (0.55, 0.6, 0.65)
    """Red, green, blue of a shape in [0, 1]."""
    pos: Vec3 = (0.0, 0.0, 0.0)
    """Position of the MJCF's origin, or of the middle of the shape, in the environment's frame [m]."""
    quat: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """Orientation (w, x, y, z)."""
    joints: dict[str, JointConfig] = {}
    """Joint name or regex -> what to change; where two match, the later one wins key by key."""
    actuators: dict[str, ActuatorConfig] = {}
    """Name -> actuator model; joints that none of them drives keep MuJoCo's actuators."""
    init: InitialStateConfig = InitialStateConfig()
    """Default state; a joint not named starts at the MJCF's qpos0, at rest."""
    soft_joint_pos_limit_factor: Annotated[float, Field(gt=0, le=1), _FractionString()] = 1.0
    """Share of the joint range, about its middle, that counts as inside the soft limits."""

    @model_validator(mode="after")
    def _one_kind(self) -> EntityConfig:
        if (self.model is None) == (self.shape is None):
            raise ValueError("an entity is a model (an MJCF file) or a shape: write one of the two")
        if self.model is not None:
            given = [key for key in ("size", "mass", "density") if getattr(self, key) is not None]
            given += [key for key in ("free", "mocap") if getattr(self, key)]
            if given:
                raise ValueError(f"'{given[0]}' belongs to a shape; of a model the MJCF says it")
            return self
        self._check_shape()
        return self

    def _check_shape(self) -> None:
        assert self.shape is not None
        wanted = SHAPE_SIZES[self.shape]
        count = wanted.partition("]")[0].count(",") + 1
        if self.size is None or len(self.size) != count:
            found = "none" if self.size is None else f"{len(self.size)} numbers"
            raise ValueError(f"size of a {self.shape} is {wanted} [m]; found {found}")
        if self.mass is not None and self.density is not None:
            raise ValueError("mass and density exclude each other")
        if self.free and self.mocap:
            raise ValueError("free and mocap exclude each other")
        if self.shape == "plane" and (self.free or self.mocap):
            raise ValueError("a plane cannot move; a flat box can")


class SceneConfig(StrictModel):
    """What stands in each environment."""

    num_envs: Annotated[int, Field(ge=1, le=1 << 24)] = 1024
    """Environments simulated in parallel."""
    env_spacing: NotNegative = 4.0
    """Distance between environments on the grid that viewers draw [m]; physics runs at each world's origin."""
    ground: GroundConfig | None = GroundConfig()
    """Ground plane; null for none. A terrain replaces it."""
    terrain: TerrainConfig | None = None
    """Uneven ground, shared by all environments, each at its own place on it."""
    lights: LightsConfig = LightsConfig(dome=DomeLightConfig())
    """Lights."""
    entities: Annotated[dict[str, EntityConfig], Field(json_schema_extra={"minProperties": 1})]
    """Name -> robot or object."""
    sensors: dict[str, SensorConfig] = {}
    """Name -> contact sensor, ray sensor or camera, for terms that ask for one. Sensors of the MJCF need no entry."""

    @field_validator("entities")
    @classmethod
    def _not_empty(cls, value: dict[str, EntityConfig], info: ValidationInfo) -> dict[str, EntityConfig]:
        if not value and not (info.context or {}).get("open_scene"):
            raise PydanticKnownError("too_short", {"field_type": "Dictionary", "min_length": 1, "actual_length": 0})
        return value

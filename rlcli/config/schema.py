"""The schema of a task: every key of a `task.yaml` with its unit, its range and its default.

Terms (the entries of `rewards:`, `events:`, ...) are open here: their parameters are the keyword-only parameters of
the function they name, checked by `rlcli.config.terms`.
"""

from __future__ import annotations

import math
import re
import sys
from types import ModuleType
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import CoreSchema, PydanticKnownError, core_schema

_FRACTION = re.compile(r"\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*/\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*\Z")


def _fraction(value: Any) -> Any:
    """`1/120` is a number where a number is expected."""
    if isinstance(value, str) and (match := _FRACTION.match(value)):
        try:
            return float(match[1]) / float(match[2])
        except (ValueError, ZeroDivisionError):
            return value
    return value


class _Fraction:
    """Lets a number be written as a fraction, and says so in the JSON Schema."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(_fraction, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"anyOf": [handler(schema), {"type": "string", "pattern": "^" + _FRACTION.pattern.replace(r"\Z", "$")}]}


def _ordered(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError(f"the lower end {value[0]:g} is above the upper end {value[1]:g}")
    return value


def _rotation(value: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    if math.hypot(*value) < 1e-6:
        raise ValueError("a quaternion must not be zero; no rotation is [1, 0, 0, 0]")
    return value


class _Function:
    """Lets a term's function stand for its name in a configuration that is built in Python."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        name = core_schema.str_schema(strict=True)
        either = core_schema.union_schema([name, core_schema.callable_schema()])
        return core_schema.json_or_python_schema(json_schema=name, python_schema=either)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"type": "string"}


def _direction(value: tuple[float, float, float]) -> tuple[float, float, float]:
    if math.hypot(*value) < 1e-6:
        raise ValueError("a direction must not be zero; straight down is [0, 0, -1]")
    return value


Number = Annotated[float, _Fraction()]
Positive = Annotated[float, Field(gt=0), _Fraction()]
NotNegative = Annotated[float, Field(ge=0), _Fraction()]
Count = Annotated[int, Field(ge=1)]
_Threads = Annotated[int, Field(ge=1, le=4096)]
_Share = Annotated[float, Field(ge=0, le=1), _Fraction()]
Vec3 = tuple[Number, Number, Number]
Quaternion = Annotated[tuple[Number, Number, Number, Number], AfterValidator(_rotation)]
Range = Annotated[tuple[Number, Number], AfterValidator(_ordered)]
Names = str | Annotated[list[str], Field(min_length=1)]


class StrictModel(BaseModel):
    """Base of every configuration model: unknown keys, wrong types, NaN and later changes are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)
    _defined_in: ClassVar[ModuleType | None]

    def __init_subclass__(cls, **settings: Any) -> None:
        super().__init_subclass__(**settings)
        cls._defined_in = sys.modules.get(cls.__module__)

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Read docstrings only when somebody asks for a schema: pydantic would while the models are made, which then
        takes half as long again.
        """
        from rlcli.config.docstrings import describe

        described = super().__get_pydantic_json_schema__(schema, handler)
        describe(handler.resolve_ref_schema(described), cls)
        return described


class TermConfig(StrictModel):
    """One term: the function it calls, and that function's parameters as further keys."""

    model_config = ConfigDict(extra="allow")

    func: Annotated[str, _Function()]
    """Name of the function, looked up in the task's own terms, then in rlcli.mdp; in Python also the function."""

    @property
    def params(self) -> dict[str, Any]:
        """The parameters of the function, validated, defaults filled in."""
        return dict(self.model_extra or {})


class RewardConfig(TermConfig):
    """A reward term; its contribution a step is weight x value x step_dt."""

    weight: Number
    """Signed weight."""
    while_alive: bool = False
    """True: pays nothing in the step in which the episode is terminated."""


class TerminationConfig(TermConfig):
    """A termination term."""

    time_out: bool = False
    """True: ends the episode as truncated (the value of the last state is bootstrapped), not as terminated."""


class EventConfig(TermConfig):
    """Something that happens to some environments at some time."""

    mode: Literal["startup", "reset", "interval"]
    """startup: once; reset: when an episode starts; interval: again and again."""
    interval_range_s: Range | None = None
    """[low, high] time between two firings [s], drawn an environment; required by mode interval."""
    global_time: bool = False
    """Mode interval: one timer for all environments, which resets do not restart."""
    min_steps_between: Annotated[int, Field(ge=0)] = 0
    """Mode reset: environment steps that must have passed since the last firing; the first reset always fires."""

    @model_validator(mode="after")
    def _interval(self) -> EventConfig:
        if (self.mode == "interval") != (self.interval_range_s is not None):
            raise ValueError("interval_range_s belongs to mode interval, and mode interval needs it")
        if self.interval_range_s is not None and self.interval_range_s[0] <= 0:
            raise ValueError("interval_range_s must be above 0")
        if self.global_time and self.mode != "interval":
            raise ValueError("global_time belongs to mode interval")
        if self.min_steps_between and self.mode != "reset":
            raise ValueError("min_steps_between belongs to mode reset")
        return self


Columns = Number | Annotated[list[Number], Field(min_length=1)]
"""One number for all columns of a term, or one each."""


class _NoiseConfig(StrictModel):
    operation: Literal["add", "scale", "set"] = "add"
    """add: value + draw; scale: value x draw; set: the draw alone."""


class UniformNoiseConfig(_NoiseConfig):
    """Uniform noise."""

    kind: Literal["uniform"]
    low: Columns = -1.0
    """Lower end of each draw, in the term's unit (a factor, to scale)."""
    high: Columns = 1.0
    """Upper end."""


class GaussianNoiseConfig(_NoiseConfig):
    """Gaussian noise."""

    kind: Literal["gaussian"]
    mean: Columns = 0.0
    """Mean of each draw, in the term's unit (a factor, to scale)."""
    std: Columns = 1.0
    """Standard deviation."""


class ConstantNoiseConfig(_NoiseConfig):
    """The same value in every step."""

    kind: Literal["constant"]
    value: Columns = 0.0
    """What is added, multiplied or set, in the term's unit (a factor, to scale)."""


NoiseConfig = Annotated[UniformNoiseConfig | GaussianNoiseConfig | ConstantNoiseConfig, Field(discriminator="kind")]


class ScaleModifierConfig(StrictModel):
    """value x factor."""

    kind: Literal["scale"]
    factor: Columns
    """Factor."""


class BiasModifierConfig(StrictModel):
    """value + offset."""

    kind: Literal["bias"]
    offset: Columns
    """What is added, in the term's unit."""


class ClipModifierConfig(StrictModel):
    """The value within bounds."""

    kind: Literal["clip"]
    bounds: Range
    """[low, high], in the term's unit."""


class DigitalFilterModifierConfig(StrictModel):
    """y[i] = sum_j b[j] x[i-j] - sum_j a[j] y[i-1-j], with zeros before an episode's first step."""

    kind: Literal["digital_filter"]
    a: list[Number] = []
    """Weights of past outputs, the last one first; none for a filter without feedback."""
    b: Annotated[list[Number], Field(min_length=1)]
    """Weights of the input of this step and of those before."""


class IntegratorModifierConfig(StrictModel):
    """Integral over the episode by the trapezoidal rule."""

    kind: Literal["integrator"]


ModifierConfig = Annotated[
    ScaleModifierConfig
    | BiasModifierConfig
    | ClipModifierConfig
    | DigitalFilterModifierConfig
    | IntegratorModifierConfig,
    Field(discriminator="kind"),
]


class DelayConfig(StrictModel):
    """What the policy sees is some steps old; in an episode's first steps it is the first value."""

    steps: Annotated[tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0, le=1000)]], AfterValidator(_ordered)]
    """[low, high] environment steps, drawn an environment at the start of each episode; both ends included."""
    redraw: Annotated[float, Field(ge=0, le=1), _Fraction()] = 0.0
    """Chance that an environment draws its delay anew in a step."""


class ObservationConfig(TermConfig):
    """An observation term: value, modifiers, noise, bias, clip, scale, delay, history, in this order."""

    modifiers: list[ModifierConfig] = []
    """What is done to the value first, in order."""
    noise: NoiseConfig | None = None
    """Drawn anew in every step."""
    bias: NoiseConfig | None = None
    """Drawn at the start of every episode, from nothing but its own distribution: it does not drift."""
    clip: Range | None = None
    """[low, high] limits."""
    scale: Columns | None = None
    """Factor, one for all columns or one each."""
    delay: DelayConfig | None = None
    """How old what is seen is."""
    history: Count | None = None
    """Steps kept: columns of the oldest first; an episode begins with its first value in all of them."""


class ObservationGroupConfig(StrictModel):
    """A group of observation terms, side by side in order; further keys are its terms."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, ObservationConfig | None] = Field(init=False)

    enable_corruption: bool = True
    """false: the terms' noise, bias and delay are left out."""
    history: Count | None = None
    """History of every term, over the terms' own; null leaves it to them."""

    @property
    def terms(self) -> dict[str, ObservationConfig | None]:
        """The terms by name, in order."""
        return dict(self.__pydantic_extra__ or {})


class ActionConfig(TermConfig):
    """An action term; it takes its columns of the policy's output."""


class CommandConfig(TermConfig):
    """Something that the policy is asked to do, drawn anew from time to time."""

    resampling_time_s: Range
    """[low, high] time until the next draw [s], drawn an environment; each episode begins with a new one."""

    @field_validator("resampling_time_s")
    @classmethod
    def _some_time(cls, value: tuple[float, float]) -> tuple[float, float]:
        if value[0] <= 0:
            raise ValueError("resampling_time_s must be above 0")
        return value


class CurriculumConfig(TermConfig):
    """Something that changes while training goes on."""


class SuccessConfig(TermConfig):
    """When an episode counts as a success: the term held during its last `hold_s` seconds and time ran out."""

    hold_s: NotNegative = 1.0
    """How long the condition must have held when the episode times out [s]."""


class SimConfig(StrictModel):
    """The simulation."""

    dt: Annotated[float, Field(gt=0, le=0.1), _Fraction()]
    """Physics time step [s]."""
    render_interval: Count = 1
    """Physics steps between two frames of a video; never less than one environment step."""
    gravity: Vec3 = (0.0, 0.0, -9.81)
    """Gravity in the world frame [m/s^2]."""
    integrator: Literal["euler", "rk4", "implicit", "implicitfast"] | None = None
    """MuJoCo's integrator; null takes the first entity's MJCF."""
    iterations: Count | None = None
    """Solver iterations; null takes the first entity's MJCF."""
    ls_iterations: Count | None = None
    """Line-search iterations of the solver; null takes the first entity's MJCF."""
    engine: Literal["auto", "batch", "warp"] = "auto"
    """What steps the worlds: auto is batch (MuJoCo's threads) on a CPU and warp (MuJoCo Warp) on a GPU."""
    engine_threads: _Threads | None = None
    """Threads that step physics; null is every core this process may use."""
    forces_after_reset: bool = True
    """Compute accelerations and forces of a start state; false: they are 0 until an episode's first step, which saves
    a GPU that reads them a forward pass over all environments a step."""
    derived_fields: Literal["current", "substep"] = "current"
    """What is read of the fields that MuJoCo derives from the state (xpos, cvel, sensordata, ...): current is that of
    the state after the step; substep is what the last physics step left, which describes the state before it, and
    saves computing them anew: as one reads them after `mj_step`."""
    external_forces: bool = False
    """Compute `cfrc_ext`, the forces of contacts on bodies, after every step, as `mj_rnePostConstraint` does; they are
    0 in a start state. On a CPU it takes about 15 us for each environment that touches something."""
    max_velocity: Positive | None = None
    """Speed of a joint or a free body [m/s, rad/s] beyond which an environment counts as diverged, after an environment
    step; null: MuJoCo's own bound, 1e10. A contact that throws a body at a finite 1e6 m/s ruins a learner."""
    contacts_per_env: Count | None = None
    """Room for contacts that warp sets aside, an environment; null estimates it from the model."""
    constraints_per_env: Count | None = None
    """Room for constraint rows (limits, friction, contacts) likewise."""


class ViewerConfig(StrictModel):
    """Where the camera stands."""

    eye: Vec3 = (4.0, 4.0, 3.0)
    """Camera position [m], world frame of the environment shown."""
    lookat: Vec3 = (0.0, 0.0, 0.0)
    """Point the camera looks at [m]."""
    follow: str | None = None
    """Entity that the camera of pictures and videos goes along with, as far as its root is from where the entity's
    default state has it; null: the camera stands still."""
    width: Annotated[int, Field(ge=16, le=3840)] = 640
    """Picture width [pixels]."""
    height: Annotated[int, Field(ge=16, le=2160)] = 480
    """Picture height [pixels]."""


Color = tuple[
    Annotated[float, Field(ge=0, le=1)],
    Annotated[float, Field(ge=0, le=1)],
    Annotated[float, Field(ge=0, le=1)],
]


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
    delay: Annotated[
        tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0, le=1000)]], AfterValidator(_ordered)
    ] = (0, 0)
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


_SIZES = {
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
    soft_joint_pos_limit_factor: Annotated[float, Field(gt=0, le=1), _Fraction()] = 1.0
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
        wanted = _SIZES[self.shape]
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


class TouchedConfig(StrictModel):
    """What a contact sensor listens to contacts with."""

    entity: str
    """Name of an entity."""
    bodies: Names | None = None
    """Names or regexes of its bodies; null: all of them."""


class ContactSensorConfig(StrictModel):
    """What touches bodies of an entity: net force, and how long they have been in contact or in the air."""

    kind: Literal["contact"]
    """contact."""
    entity: str = "robot"
    """Name of an entity."""
    bodies: Names
    """Names or regexes of its bodies, one slot each in the order written."""
    against: Literal["ground"] | TouchedConfig | None = None
    """Only contacts with this: ground (the plane or the terrain), or bodies of an entity; null: with anything."""
    history: Count = 1
    """Steps that `force_history` keeps."""
    force_threshold: NotNegative = 0.0
    """Net force from which on a body counts as in contact [N]; 0: any contact does."""


class GridPatternConfig(StrictModel):
    """Parallel rays that start from a grid about the sensor, x running fastest."""

    size: tuple[NotNegative, NotNegative]
    """Extent along x and y [m]."""
    resolution: Positive
    """Distance between neighbouring rays [m]."""
    direction: Annotated[Vec3, AfterValidator(_direction)] = (0.0, 0.0, -1.0)
    """Where the rays go, in the sensor's frame."""


class RaySensorConfig(StrictModel):
    """Distances along rays from a body, as a height scanner or a lidar gives them."""

    kind: Literal["rays"]
    """rays."""
    entity: str = "robot"
    """Name of an entity."""
    body: str | None = None
    """The body that carries the sensor; null: the root."""
    pattern: GridPatternConfig | Annotated[list[Annotated[Vec3, AfterValidator(_direction)]], Field(min_length=1)]
    """A grid of parallel rays, or a list of directions from one point, in the sensor's frame."""
    offset: Vec3 = (0.0, 0.0, 0.0)
    """Where the sensor sits in its frame [m]."""
    alignment: Literal["base", "yaw", "world"] = "base"
    """Axes of the sensor's frame: those of the body, those of the body's heading with z up, or the world's."""
    max_distance: Positive = 10.0
    """Range [m]; what lies farther is missed."""
    sees: Literal["ground", "all"] | Annotated[list[Annotated[int, Field(ge=0, le=5)]], Field(min_length=1)] = "ground"
    """ground: the plane or the terrain; all: every geom but those of the body; or a list of geom groups."""
    lookup: bool = False
    """Rays straight down find the ground in the table of the terrain's heights instead of among geoms: the same to
    rounding, and much faster on a GPU. For a terrain without boxes, and alignment yaw or world."""

    @model_validator(mode="after")
    def _straight_down(self) -> RaySensorConfig:
        if not self.lookup:
            return self
        pattern = self.pattern
        directions = [pattern.direction] if isinstance(pattern, GridPatternConfig) else pattern
        if any(x or y or z >= 0.0 for x, y, z in directions) or self.alignment == "base":
            raise ValueError("lookup is for rays straight down: directions [0, 0, -1], alignment yaw or world")
        if self.sees != "ground":
            raise ValueError("lookup is for rays that see the ground alone: sees: ground")
        return self


class CameraSensorConfig(StrictModel):
    """Pictures of every environment, drawn offscreen once an environment step: colours, or how far things are."""

    kind: Literal["camera"]
    """camera."""
    data: Literal["rgb", "depth", "distance"] = "rgb"
    """rgb: red, green and blue, 0 to 255; depth: along the camera's axis [m]; distance: from the camera's place [m]."""
    width: Annotated[int, Field(ge=1, le=1024)]
    """Columns of the picture."""
    height: Annotated[int, Field(ge=1, le=1024)]
    """Rows of the picture."""
    entity: str | None = None
    """The entity that the camera belongs to; null: it stands in the environment."""
    camera: str | None = None
    """A camera of the entity's MJCF, with its place and its field of view; null: what follows says them."""
    body: str | None = None
    """The body of the entity that carries the camera; null: its root."""
    eye: Vec3 = (-3.0, 0.0, 1.0)
    """Where the camera sits, in the frame of what carries it [m]."""
    lookat: Vec3 = (0.0, 0.0, 0.0)
    """A point in the middle of the picture, in the same frame [m]. The frame's z axis is up in it, or x if the camera
    looks along z."""
    fov: Annotated[float, Field(gt=0, lt=180)] = 45.0
    """Field of view from the lower to the upper edge [degrees]."""
    clip: tuple[Positive, Positive] = (0.01, 20.0)
    """What is nearer or farther than this along the camera's axis is not seen [m]."""
    samples: Annotated[int, Field(ge=1, le=8)] = 1
    """Each pixel is the mean of so many by so many: edges are soft, and things smaller than a pixel show."""

    @model_validator(mode="after")
    def _relations(self) -> CameraSensorConfig:
        if self.entity is None and (self.camera or self.body):
            raise ValueError("camera and body are those of an entity: name it")
        placed = sorted({"body", "eye", "lookat", "fov"} & self.model_fields_set)
        if self.camera is not None and placed:
            raise ValueError(f"a camera of the MJCF has its own place and field of view: leave {', '.join(placed)} out")
        if self.clip[0] >= self.clip[1]:
            raise ValueError(f"clip: {self.clip[0]:g} is not below {self.clip[1]:g}")
        if self.eye == self.lookat:
            raise ValueError("eye and lookat are one point: the camera has no direction")
        return self


SensorConfig = Annotated[ContactSensorConfig | RaySensorConfig | CameraSensorConfig, Field(discriminator="kind")]


class PatchConfig(StrictModel):
    """What all sub-terrains have in common. Pairs of values are those of difficulty 0 and of difficulty 1."""

    proportion: NotNegative = 1.0
    """Share of the columns (without curriculum: of the patches), relative to the other sub-terrains."""


class FlatPatchConfig(PatchConfig):
    """Flat ground."""

    kind: Literal["flat"]
    """flat."""


class NoisePatchConfig(PatchConfig):
    """Uneven ground: uniform random heights."""

    kind: Literal["noise"]
    """noise."""
    height: Range = (0.02, 0.1)
    """Heights lie within +-this [m]."""
    spacing: Positive = 0.2
    """Distance between two random heights; between them the ground is straight [m]."""


class SlopePatchConfig(PatchConfig):
    """A pyramid of four slopes."""

    kind: Literal["slope"]
    """slope."""
    slope: Range = (0.0, 0.4)
    """Rise over run."""
    platform: NotNegative = 2.0
    """Edge of the flat middle [m]."""
    inverted: bool = False
    """Down to the middle instead of up."""


class WavesPatchConfig(PatchConfig):
    """Sine waves along x and y."""

    kind: Literal["waves"]
    """waves."""
    amplitude: Range = (0.05, 0.2)
    """Half the height from trough to crest [m]."""
    count: Count = 2
    """Waves along an edge."""


class ObstaclesPatchConfig(PatchConfig):
    """Low blocks and pits in random places."""

    kind: Literal["obstacles"]
    """obstacles."""
    height: Range = (0.05, 0.2)
    """Height of blocks, depth of pits [m]."""
    width: Range = (0.25, 1.0)
    """[narrowest, widest] edge of an obstacle [m]."""
    count: Count = 40
    """Obstacles in a patch."""
    platform: NotNegative = 2.0
    """Edge of the flat middle [m]."""


class StonesPatchConfig(PatchConfig):
    """Stepping stones over a pit."""

    kind: Literal["stones"]
    """stones."""
    width: Range = (0.25, 1.0)
    """[narrowest, widest] edge of a stone [m]; at difficulty 0 stones are wide."""
    gap: Range = (0.05, 0.3)
    """Distance between stones [m]."""
    depth: Positive = 1.0
    """Depth of the pit [m]."""
    platform: NotNegative = 2.0
    """Edge of the flat middle [m]."""


class StairsPatchConfig(PatchConfig):
    """Stairs on four sides."""

    kind: Literal["stairs"]
    """stairs."""
    step_height: Range = (0.05, 0.2)
    """Height of a step [m]."""
    step_width: Positive = 0.3
    """Depth of a step [m]."""
    platform: NotNegative = 2.0
    """Edge of the flat middle [m]."""
    inverted: bool = False
    """Down to the middle instead of up."""
    boxes: bool = False
    """Boxes with upright faces; false: part of the height field, whose faces lean by one cell. Boxes cost time."""


class GridPatchConfig(PatchConfig):
    """A grid of cells of random heights."""

    kind: Literal["grid"]
    """grid."""
    cell: Positive = 0.5
    """Edge of a cell [m]."""
    height: Range = (0.02, 0.15)
    """Heights lie within +-this [m]."""
    platform: NotNegative = 2.0
    """Edge of the flat middle [m]."""
    boxes: bool = False
    """Boxes with upright faces; false: part of the height field, whose faces lean by one cell. Boxes cost time."""


SubTerrainConfig = Annotated[
    FlatPatchConfig
    | NoisePatchConfig
    | SlopePatchConfig
    | WavesPatchConfig
    | ObstaclesPatchConfig
    | StonesPatchConfig
    | StairsPatchConfig
    | GridPatchConfig,
    Field(discriminator="kind"),
]


class TerrainGeneratorConfig(StrictModel):
    """Patches in rows of rising difficulty, a kind of ground in each column; environments start in their middles."""

    kind: Literal["generator"]
    """generator."""
    rows: Count = 10
    """Levels of difficulty, along x."""
    columns: Count = 10
    """Patches of a level, along y; environment i has column i modulo this."""
    patch: tuple[Positive, Positive] = (8.0, 8.0)
    """Extent of a patch along x and y [m]."""
    border: NotNegative = 10.0
    """Flat ground about the patches [m]."""
    resolution: Positive = 0.1
    """Distance between two heights of the height field [m]."""
    sub_terrains: Annotated[dict[str, SubTerrainConfig], Field(min_length=1)]
    """Name -> a kind of ground."""
    difficulty: Annotated[tuple[_Share, _Share], AfterValidator(_ordered)] = (0.0, 1.0)
    """Difficulty of the first and of the last row, in [0, 1]."""
    curriculum: bool = True
    """A kind of ground for each column, difficulty by row; false: both are drawn for each patch."""
    max_start_level: Annotated[int, Field(ge=0)] | None = None
    """Environments begin at random levels up to this one; null: the last."""
    seed: int = 0
    """Of the terrain's random heights."""
    friction: NotNegative = 1.0
    """Sliding friction."""

    @field_validator("sub_terrains")
    @classmethod
    def _some_ground(cls, value: dict[str, SubTerrainConfig]) -> dict[str, SubTerrainConfig]:
        if sum(patch.proportion for patch in value.values()) <= 0.0:
            raise ValueError("the proportions of the sub-terrains sum to 0; one must be above 0")
        return value


class TerrainHeightsConfig(StrictModel):
    """Ground of one's own: a height field from a file. All environments start in its middle."""

    kind: Literal["heights"]
    """heights."""
    file: str
    """A NumPy file (.npy) in the task's folder: heights [m], one row along y for each x."""
    resolution: Positive
    """Distance between two heights [m]."""
    friction: NotNegative = 1.0
    """Sliding friction."""


TerrainConfig = Annotated[TerrainGeneratorConfig | TerrainHeightsConfig, Field(discriminator="kind")]


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


class TaskConfig(StrictModel):
    """A whole task. Manager-based tasks fill actions ... terminations, direct tasks `params`."""

    summary: str = ""
    """One line that says what the task is."""
    sim: SimConfig
    """Physics."""
    decimation: Count
    """Physics steps an environment step; step_dt = dt x decimation."""
    episode_length_s: Positive
    """Length of an episode [s]; it is truncated there."""
    scene: SceneConfig
    """Environments, ground, lights, robots."""
    viewer: ViewerConfig = ViewerConfig()
    """Camera of videos and windows."""
    actions: dict[str, ActionConfig | None] = {}
    """Action terms, in the order of the policy's output; null removes one."""
    commands: dict[str, CommandConfig | None] = {}
    """Command terms."""
    observations: dict[str, ObservationGroupConfig] = {}
    """Groups of observation terms; the policy reads the group `policy`."""
    events: dict[str, EventConfig | None] = {}
    """Event terms."""
    rewards: dict[str, RewardConfig | None] = {}
    """Reward terms."""
    terminations: dict[str, TerminationConfig | None] = {}
    """Termination terms."""
    curriculum: dict[str, CurriculumConfig | None] = {}
    """Curriculum terms."""
    success: SuccessConfig | None = None
    """What makes an episode a success in `eval`."""
    reward_dt_scaling: bool = True
    """Multiply manager-based rewards by step_dt, so that returns do not depend on the control rate."""
    divergence_reward: Number | None = None
    """Reward of the step in which an environment diverged; null: that of its last finite state, terminated."""
    params: dict[str, Any] = {}
    """Parameters of a direct task, checked by the task's own Params."""
    oige: dict[str, Any] = {}
    """A task of OmniIsaacGymEnvs: what its class reads as `_task_cfg`, beside what the keys above say."""
    clip_actions: Positive | None = None
    """Direct tasks: actions are clamped to +-this before pre_physics_step."""
    clip_observations: Positive | None = None
    """Direct tasks: observations are clamped to +-this."""
    play: dict[str, Any] = {}
    """Patch of this configuration for play and eval."""
    agents: dict[str, Any] = {}
    """Name -> settings of a trainer; `default` names the one to use, by itself or by device."""

    @field_validator("episode_length_s")
    @classmethod
    def _at_least_one_step(cls, value: float, info: ValidationInfo) -> float:
        if "sim" in info.data and "decimation" in info.data:
            step_dt = info.data["sim"].dt * info.data["decimation"]
            if value < step_dt:
                raise ValueError(f"{value:g} s is shorter than one step (dt x decimation = {step_dt:g} s)")
        return value

    @field_validator("viewer")
    @classmethod
    def _something_to_follow(cls, value: ViewerConfig, info: ValidationInfo) -> ViewerConfig:
        scene = info.data.get("scene")
        if value.follow is not None and scene is not None and value.follow not in scene.entities:
            have = ", ".join(scene.entities)
            raise ValueError(f"follow: there is no entity '{value.follow}' in the scene; entities: {have}")
        return value

    @property
    def step_dt(self) -> float:
        """Control period [s]."""
        return self.sim.dt * self.decimation

    @property
    def max_episode_length(self) -> int:
        """Steps of an episode; the small slack absorbs rounding, so that 5 s at 1/60 s is 300 steps."""
        return math.ceil(self.episode_length_s / self.step_dt - 1e-6)


class AutopsyConfig(StrictModel):
    """What is kept, while training, of episodes that ended badly or unlike the others; `rlcli autopsy RUN` shows it."""

    seconds: Annotated[float, Field(gt=0, le=60), _Fraction()] = 2.0
    """How much of an episode's end [s]."""
    keep: Annotated[int, Field(ge=1, le=1000)] = 32
    """Episodes that stay: the newest, of every kind of end some."""
    memory_mib: Annotated[int, Field(ge=1, le=1_000_000)] = 256
    """What the last seconds of all environments may take [MiB]; where they do not fit, fewer seconds are kept."""


class AgentConfig(StrictModel):
    """What every trainer's settings have in common; a trainer's own model extends it."""

    trainer: str
    """Name of a trainer (entry-point group rlcli.trainers)."""
    algorithm: str
    """Algorithm of that trainer."""
    task: dict[str, Any] = {}
    """Patch of the task for what this agent was tuned for."""
    max_iterations: Count | None = None
    """Iterations to train for."""
    max_steps: Count | None = None
    """Environment steps to train for."""
    save_interval: Count | None = None
    """Iterations between checkpoints; null: every 60 s and at the end."""
    keep_last: Count | None = None
    """Newest checkpoints that stay, beside the first and the best; null: 10, or all where `save_interval` is set."""
    keep_every: Count | None = None
    """Checkpoints of every such iteration are written, and stay."""
    eval_interval: Count | None = None
    """Iterations between evaluations of the policy, as `rlcli eval` does it; the best one's checkpoint is RUN@best.
    null: none."""
    eval_episodes: Count = 100
    """Episodes of such an evaluation."""
    autopsy: AutopsyConfig | None = AutopsyConfig()
    """Ends of episodes that are kept while training on a CPU; null: none."""
    torch_threads: _Threads | None = None
    """Threads of the update; null: min(4, cores). Results are equal only for an equal number."""
    action_bound: Positive | None = 1.0
    """The policy's actions are clipped to +-this in training, play and export alike; null: unbounded."""

    @model_validator(mode="after")
    def _budget(self) -> AgentConfig:
        if self.max_iterations is None and self.max_steps is None:
            raise ValueError("one of max_iterations and max_steps is needed")
        return self

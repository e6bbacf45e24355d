"""Schema of the terms of manager-based tasks: the keys that all terms of a section share.

Each term has further keys, the keyword-only parameters of its function. `rlcli.config.term_signatures` checks them.
"""

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import (
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import CoreSchema, core_schema

from rlcli.config.schema.base import (
    Count,
    NotNegative,
    Number,
    Range,
    SecondsRange,
    Share,
    StepRange,
    StrictModel,
    _Limits,
)

Columns = Number | Annotated[list[Number], Field(min_length=1)]
"""One number for all columns of a term, or one number for each column."""


class _TermFunction:
    """Annotation for the name of a term's function. A configuration in Python may have the function itself."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        name = core_schema.str_schema(strict=True)
        either = core_schema.union_schema([name, core_schema.callable_schema()])
        return core_schema.json_or_python_schema(json_schema=name, python_schema=either)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"type": "string"}


class TermConfig(StrictModel):
    """A term: `func` names its function; all other keys are parameters of this function."""

    model_config = ConfigDict(extra="allow")

    func: Annotated[str, _TermFunction()]
    """Name of the function or class, searched in the task's own terms, then in rlcli.mdp. A configuration in Python may
    have the function itself."""

    @property
    def params(self) -> dict[str, Any]:
        """The validated parameters of the function, with defaults."""
        return dict(self.model_extra or {})


class RewardConfig(TermConfig):
    """A reward term, which adds weight x value x step_dt to the reward of each step.

    With `reward_dt_scaling: false` the term adds weight x value.
    """

    weight: Number
    """Weight; negative for a penalty."""
    while_alive: bool = False
    """true: the term is 0 in the step in which the episode is terminated."""


class TerminationConfig(TermConfig):
    """A termination term. Its function returns in which environments the episode ends."""

    time_out: bool = False
    """true: the episode is truncated (the value of the last state is bootstrapped); false: it is terminated."""


class EventConfig(TermConfig):
    """A change of environments at certain times, for example a reset, a push or a randomisation."""

    mode: Literal["startup", "reset", "interval"]
    """startup: once at the start; reset: when an episode starts; interval: repeatedly."""
    interval_range_s: SecondsRange | None = None
    """[low, high] time between two events [s], drawn for each environment; required by mode interval. 0: every step."""
    global_time: bool = False
    """Mode interval: true: one timer for all environments, which resets do not restart."""
    min_steps_between: Annotated[int, Field(ge=0)] = 0
    """Mode reset: smallest number of environment steps between two events. The first reset always triggers the
    event."""

    @model_validator(mode="after")
    def _interval(self) -> Self:
        if (self.mode == "interval") != (self.interval_range_s is not None):
            raise ValueError("interval_range_s and mode: interval need each other: set both or neither")

        if self.global_time and self.mode != "interval":
            raise ValueError("global_time belongs to mode interval; remove it or set mode: interval")
        if self.min_steps_between and self.mode != "reset":
            raise ValueError("min_steps_between belongs to mode reset; remove it or set mode: reset")
        return self


class _NoiseConfig(StrictModel):
    operation: Literal["add", "scale", "set"] = "add"
    """add: value + sample; scale: value x sample; set: the sample replaces the value."""


class UniformNoiseConfig(_NoiseConfig):
    """Uniform noise."""

    kind: Literal["uniform"]
    """Kind of noise: always uniform."""
    low: Columns = -1.0
    """Lower end of the samples, in the unit of the term (for `operation: scale` a factor)."""
    high: Columns = 1.0
    """Upper end of the samples, in the unit of `low`."""


class GaussianNoiseConfig(_NoiseConfig):
    """Gaussian noise."""

    kind: Literal["gaussian"]
    """Kind of noise: always gaussian."""
    mean: Columns = 0.0
    """Mean of the samples, in the unit of the term (for `operation: scale` a factor)."""
    std: Columns = 1.0
    """Standard deviation of the samples, in the unit of `mean`."""


class ConstantNoiseConfig(_NoiseConfig):
    """A constant value, the same in every step."""

    kind: Literal["constant"]
    """Kind of noise: always constant."""
    value: Columns = 0.0
    """The value, in the unit of the term (for `operation: scale` a factor)."""


NoiseConfig = Annotated[UniformNoiseConfig | GaussianNoiseConfig | ConstantNoiseConfig, Field(discriminator="kind")]
"""Noise of an observation; the key `kind` selects uniform, gaussian or constant noise."""


class ScaleModifierConfig(StrictModel):
    """Multiply: value x factor."""

    kind: Literal["scale"]
    """Kind of modifier: always scale."""
    factor: Columns
    """Factor."""


class BiasModifierConfig(StrictModel):
    """Add: value + offset."""

    kind: Literal["bias"]
    """Kind of modifier: always bias."""
    offset: Columns
    """Offset, in the unit of the term."""


class ClipModifierConfig(StrictModel):
    """Limit the value to a range."""

    kind: Literal["clip"]
    """Kind of modifier: always clip."""
    bounds: Range
    """[low, high] limits, in the unit of the term."""


class DigitalFilterModifierConfig(StrictModel):
    """Digital filter: y[i] = sum_j b[j] x[i-j] - sum_j a[j] y[i-1-j], with zeros before an episode's first step."""

    kind: Literal["digital_filter"]
    """Kind of modifier: always digital_filter."""
    a: list[Number] = []
    """Coefficients of past outputs, the newest output first; empty for a filter without feedback."""
    b: Annotated[list[Number], Field(min_length=1)]
    """Coefficients of the input of this step and of past inputs, the newest first."""


class IntegratorModifierConfig(StrictModel):
    """Integral of the value over the episode, by the trapezoidal rule."""

    kind: Literal["integrator"]
    """Kind of modifier: always integrator."""


ModifierConfig = Annotated[
    ScaleModifierConfig
    | BiasModifierConfig
    | ClipModifierConfig
    | DigitalFilterModifierConfig
    | IntegratorModifierConfig,
    Field(discriminator="kind"),
]
"""Modifier of an observation, such as a filter; the key `kind` selects which one."""


class DelayConfig(StrictModel):
    """Delay of an observation or of an action term, in environment steps or in seconds.

    In the first steps of an episode the policy gets the first value of a delayed observation, and a delayed action is
    0 (the raw output of the policy).
    """

    steps: Annotated[int, Field(ge=0, le=1000)] | StepRange | None = None
    """Delay in environment steps: a number, or [low, high], both included, drawn for each environment at the start of
    an episode."""
    seconds: NotNegative | tuple[NotNegative, NotNegative] | None = None
    """Delay in seconds: a number, or [low, high], as in `steps`. Each must be a multiple of the control period
    (sim.dt x decimation)."""
    redraw: Share = 0.0
    """Probability that an environment draws a new delay in a step, in [0, 1]."""

    @model_validator(mode="after")
    def _one_unit(self) -> Self:
        if (self.steps is None) == (self.seconds is None):
            raise ValueError("a delay has either steps or seconds: give one of the two")
        return self

    def step_range(self, step_dt: float) -> tuple[int, int]:
        """Return the shortest and the longest delay in environment steps of `step_dt` seconds.

        Raises:
            ValueError: if a number of seconds is not a multiple of `step_dt`, or the longest delay is too long.
        """
        if self.steps is not None:
            return self.steps if isinstance(self.steps, tuple) else (self.steps, self.steps)
        assert self.seconds is not None
        low, high = self.seconds if isinstance(self.seconds, tuple) else (self.seconds, self.seconds)
        for value in (low, high):
            if abs(value / step_dt - round(value / step_dt)) > 1e-3:
                lower = math.floor(value / step_dt) * step_dt
                near = f"{lower:g} or {lower + step_dt:g}"
                raise ValueError(f"{value:g} s is not a multiple of the control period of {step_dt:g} s; give {near}")
        if low > high or high / step_dt > 1000:
            allowed = f"give [low, high] in seconds, with low <= high <= {1000 * step_dt:g}"
            raise ValueError(f"the delay is {low:g} to {high:g} s; {allowed}")
        return round(low / step_dt), round(high / step_dt)


_History = Annotated[Count, Field(le=10_000)]


class ObservationConfig(TermConfig):
    """An observation term. modifiers, noise, bias, clip, scale, delay and history change its value, in this order."""

    modifiers: list[ModifierConfig] = []
    """Operations on the value, applied first and in this order."""
    noise: NoiseConfig | None = None
    """Noise, sampled in every step; null: none."""
    bias: NoiseConfig | None = None
    """Constant error of an episode, sampled at the start of the episode; null: none. Errors of several episodes do not
    add up."""
    clip: Range | None = None
    """[low, high] limits of the value, in its unit; null: none."""
    scale: Columns | None = None
    """Factor for all columns, or one factor for each column; null: 1."""
    delay: DelayConfig | None = None
    """Delay with which the policy gets the value; null: none."""
    history: _History | None = None
    """Number of steps that the observation contains, the oldest first. In the first steps of an episode the missing
    values are copies of the first one. null: only the current step."""


class ObservationGroupConfig(StrictModel):
    """A group of observation terms. All further keys are terms; their values are concatenated in this order."""

    model_config = ConfigDict(extra="allow")
    __pydantic_extra__: dict[str, ObservationConfig | None] = Field(init=False)

    enable_corruption: bool = True
    """false: noise, bias and delay of the terms are switched off."""
    history: _History | None = None
    """History of every term, instead of the terms' own values; null: the terms' own values."""

    @property
    def terms(self) -> dict[str, ObservationConfig | None]:
        """The terms by name, in order."""
        return dict(self.__pydantic_extra__ or {})


class ActionConfig(TermConfig):
    """An action term, which turns some columns of the policy's output into controls of actuators, or into forces."""

    delay: DelayConfig | None = None
    """Delay with which the term receives its columns of the policy's output; null: none. The observation `last_action`
    and the rewards of actions are not delayed."""


class CommandConfig(TermConfig):
    """A command for the policy, for example a target velocity, which is sampled again from time to time."""

    resampling_time_s: SecondsRange
    """[low, high] time until the next sample [s], drawn for each environment; 0: every step. Each episode starts with a
    new command."""


class CurriculumConfig(TermConfig):
    """A change of the task during training, for example of its difficulty."""


class SuccessConfig(TermConfig):
    """A condition of success. An episode succeeds if it times out, and each condition held during its last `hold_s` s.

    A term that returns a number needs `at_most` or `at_least`; a term that returns a boolean takes neither.
    """

    at_most: Number | None = None
    """Largest value of the term with which the condition holds."""

    at_least: Number | None = None
    """Smallest value of the term with which the condition holds."""

    hold_s: Annotated[NotNegative, _Limits(0.0, 1e9)] = 1.0
    """How long the condition must hold before the time-out [s]; 0: in the last step."""

    @field_validator("at_least")  # at_most is validated before, because it is declared before
    @classmethod
    def _at_most_is_above(cls, low: float | None, info: ValidationInfo) -> float | None:
        high = info.data.get("at_most")
        if low is not None and high is not None and low > high:
            message = f"at_least is {low:g} and above at_most, which is {high:g}: no value meets both bounds"
            raise ValueError(f"{message}; correct one of the two bounds")
        return low


def bound_text(condition: Mapping[str, Any]) -> str:
    """Return the bounds of a condition of success as text, such as `at most 0.1`; an empty text without bounds."""
    keys = ("at_least", "at_most")
    return " and ".join(f"{key.replace('_', ' ')} {condition[key]:g}" for key in keys if condition.get(key) is not None)

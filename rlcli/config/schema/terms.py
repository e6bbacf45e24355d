"""Terms of a manager-based task: the keys that all terms of a section have.

Terms are open here: their parameters are the keyword-only parameters of the function they name, checked by
`rlcli.config.term_signatures`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, field_validator, model_validator

from rlcli.config.schema.base import (
    Columns,
    Count,
    NotNegative,
    Number,
    Range,
    Share,
    StepRange,
    StrictModel,
    _TermFunction,
)


class TermConfig(StrictModel):
    """One term: the function it calls, and that function's parameters as further keys."""

    model_config = ConfigDict(extra="allow")

    func: Annotated[str, _TermFunction()]
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

    steps: StepRange
    """[low, high] environment steps, drawn an environment at the start of each episode; both ends included."""
    redraw: Share = 0.0
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

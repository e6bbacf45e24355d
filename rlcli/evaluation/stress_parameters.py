"""Parameters of a stress test, and the parser of their values on a command line (`body_mass.pole=0.5:2`).

`rlcli.evaluation.perturbations` applies the values to an environment.
"""

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from rlcli.errors import UsageError, did_you_mean, listing
from rlcli.safe_text import float_or_nan

PHYSICAL = {
    "body_mass": "body_mass",
    "joint_damping": "dof_damping",
    "joint_friction": "dof_frictionloss",
    "joint_armature": "dof_armature",
    "joint_stiffness": "jnt_stiffness",
    "geom_friction": "geom_friction",
    "actuator_gain": "actuator_gainprm",
    "effort_limit": "actuator_forcerange",
    "gravity": "opt.gravity",
}
"""Name of a parameter -> field of MjModel that the parameter changes. Other fields can be named directly."""
SIGNALS = {
    "action_delay": "control steps",
    "action_noise": "standard deviation, in the units of the policy's actions",
    "observation_delay": "control steps",
    "observation_noise": "standard deviation, in the units of the policy's observations",
    "push": "m/s or rad/s",
}
"""Parameter that changes signals (observations, actions, pushes) and not the model -> unit of its values."""
_INTEGER = ("action_delay", "observation_delay")
_MAX_POINTS = 1000
"""Largest number of values of a sweep, and of steps of a delay."""
_MAX_VARIANTS = 10_000
_FORM = re.compile(r"(?P<name>\w+)(?:\.(?P<element>[^=]+))?=(?P<absolute>abs:)?(?P<values>[^=]+)")

Point = tuple[float, ...]
"""A variant of the task: one value for each sweep."""


@dataclass(frozen=True, slots=True)
class Sweep:
    """A parameter of a stress test, such as `body_mass.pole`, and the values that it takes."""

    parameter: str
    element: str | None
    """Name or regular expression of bodies, joints, geoms and so on; None: all."""
    absolute: bool
    """Whether a value replaces the task's value; otherwise it is a factor."""
    values: tuple[float, ...]

    @property
    def name(self) -> str:
        """Parameter and element as on the command line, such as `body_mass.pole`."""
        return self.parameter if self.element is None else f"{self.parameter}.{self.element}"

    @property
    def neutral(self) -> float | None:
        """The value that changes nothing: 1 for a factor, 0 for noise, delay and pushes; None for absolute values."""
        return 0.0 if self.parameter in SIGNALS else None if self.absolute else 1.0

    @property
    def unit(self) -> str:
        """Unit of the values."""
        return SIGNALS.get(self.parameter, "the model's unit" if self.absolute else "factor")

    @property
    def spacing(self) -> Literal["linear", "geometric"]:
        """How values are spaced in a range: factors geometrically (equal ratios), other values linearly."""
        return "geometric" if self.neutral == 1.0 and min(self.values) > 0.0 else "linear"

    def between(self, share: float) -> float:
        """Return the value at `share` of the range: the lowest value at 0, the highest at 1."""
        low, high = min(self.values), max(self.values)
        if self.parameter in _INTEGER:
            return float(round(low + (high - low) * share))
        value = low * (high / low) ** share if self.spacing == "geometric" else low + (high - low) * share
        return float(f"{value:.12g}")  # rounded, so that the middle of 0.8:1.25 is exactly 1

    def share(self, value: float) -> float:
        """Return where a value lies in the range: 0 at the lowest value, 1 at the highest."""
        low, high = min(self.values), max(self.values)
        if high == low:
            return 0.0
        if self.spacing == "geometric":
            return math.log(value / low) / math.log(high / low)
        return (value - low) / (high - low)


def read_sweeps(texts: Sequence[str], points: int) -> list[Sweep]:
    """Return the sweeps of a command line, from texts `NAME[.ELEMENT]=[abs:]LOW:HIGH[:POINTS]` or `...=A,B,C`.

    `points` is the number of values of a range that has no POINTS.

    Raises:
        UsageError: for text of another form, impossible values, a repeated parameter, or too many combinations.
    """
    sweeps: list[Sweep] = []
    for text in texts:
        sweep = _read(text, points)
        if any(sweep.name == other.name for other in sweeps):
            raise UsageError(f"--sweep: {sweep.name} is given twice; leave out one")
        sweeps.append(sweep)
    count = math.prod(len(sweep.values) for sweep in sweeps)  # before `grid` builds all combinations
    if count > _MAX_VARIANTS:
        raise UsageError(
            f"--sweep: {count:,} variants of the task, but at most {_MAX_VARIANTS:,} are allowed",
            hint="give fewer sweeps, or a smaller --points",
        )
    return sweeps


def grid(sweeps: Sequence[Sweep]) -> list[Point]:
    """Return every combination of the sweeps' values; the values of the last sweep change fastest."""
    return list(itertools.product(*(sweep.values for sweep in sweeps)))


def format_value(value: float) -> str:
    """Return a value of a sweep as text with four digits."""
    return f"{value:.4g}"


def by_name(sweeps: Sequence[Sweep], point: Point) -> dict[str, float]:
    """Return the values of the parameters in a variant (`point`) of the task, by the names of the parameters."""
    return {sweep.name: value for sweep, value in zip(sweeps, point, strict=True)}


def describe_point(sweeps: Sequence[Sweep], point: Point) -> str:
    """Return a variant (`point`) as text, such as `body_mass.pole 0.5, action_delay 2`."""
    return ", ".join(f"{name} {format_value(value)}" for name, value in by_name(sweeps, point).items())


def unknown_parameter_error(name: str, fields: Sequence[str]) -> UsageError:
    """Return the error for an unknown parameter. `fields` are the model fields that are parameters, too."""
    own = [*PHYSICAL, *SIGNALS]
    near = did_you_mean(name, [*own, *fields])
    message = f"--sweep: there is no parameter '{name}'"
    return UsageError(message, hint=near or f"write one of {listing(own)}, or the name of a field of MuJoCo's model")


def _read(text: str, points: int) -> Sweep:
    found = _FORM.fullmatch(text.strip())
    if found is None:
        message = f"--sweep '{text}' is not NAME=LOW:HIGH or NAME=A,B,C"
        raise UsageError(message, hint="for example body_mass.pole=0.5:2, action_delay=0:3, gravity=0.8,1,1.2")
    name, absolute = found["name"], found["absolute"] is not None
    if name in SIGNALS and absolute:
        message = f"--sweep {text}: values of {name} are always absolute [{SIGNALS[name]}]"
        raise UsageError(message, hint="leave out abs:")
    if name == "actuator_gain" and absolute:
        raise UsageError(f"--sweep {text}: actuator_gain is always a factor", hint="leave out abs:")
    values = _values(text, found["values"], name, points, absolute)
    lowest = min(values)
    if lowest < 0.0:
        raise UsageError(f"--sweep {text}: {name} cannot be {lowest:g}", hint="give values of 0 or more")
    if name in _INTEGER and (any(v != round(v) for v in values) or max(values) > _MAX_POINTS):
        raise UsageError(f"--sweep {text}: {name} takes whole numbers of steps", hint=f"give 0 to {_MAX_POINTS}")
    if name == "body_mass" and lowest == 0.0:
        raise UsageError(f"--sweep {text}: a mass must be above 0", hint="give values above 0")
    return Sweep(name, found["element"], absolute, values)


def _values(text: str, written: str, name: str, points: int, absolute: bool) -> tuple[float, ...]:
    if ":" not in written:
        values = tuple(_number(text, part) for part in written.split(","))
        if len(set(values)) != len(values):
            raise UsageError(f"--sweep {text}: a value appears twice; leave out one")
        return values
    ends = written.split(":")
    if len(ends) not in (2, 3):
        raise UsageError(f"--sweep {text}: write the range as LOW:HIGH or LOW:HIGH:POINTS")
    low, high = (_number(text, part) for part in ends[:2])
    if len(ends) == 3:
        if not re.fullmatch("[0-9]{1,6}", ends[2].strip()):
            raise UsageError(f"--sweep {text}: '{ends[2]}' is not a number of points; write a whole number")
        points = int(ends[2])
    if not low < high:
        raise UsageError(f"--sweep {text}: {low:g} is not below {high:g}", hint="give LOW:HIGH, or a single value")
    if not 2 <= points <= _MAX_POINTS:
        raise UsageError(
            f"--sweep {text}: {points} points are not allowed", hint=f"give 2 to {_MAX_POINTS}, or a single value"
        )
    box = Sweep(name, None, absolute, (low, high))
    inner = [box.between(i / (points - 1)) for i in range(1, points - 1)]
    return tuple(dict.fromkeys((low, *inner, high)))


def _number(text: str, part: str) -> float:
    value = float_or_nan(part)
    if not math.isfinite(value):
        raise UsageError(f"--sweep {text}: '{part.strip()}' is not a number; write a number, as in 0.5")
    return value

"""Number types with their allowed ranges, and the base class of all configuration models.

All other modules of the schema use this module.
"""

import math
import re
import sys
from dataclasses import dataclass
from types import ModuleType
from typing import Annotated, Any, ClassVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

_FRACTION = re.compile(r"\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*/\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*\Z")


def _fraction(value: object) -> Any:
    """Convert a fraction such as `1/120` to a number; return any other value as it is."""
    if isinstance(value, str) and (match := _FRACTION.match(value)):
        try:
            return float(match[1]) / float(match[2])
        except (ValueError, ZeroDivisionError):
            return value
    return value


class _FractionString:
    """Annotation for a number that may also be written as a fraction, such as `1/120`."""

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_before_validator_function(_fraction, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        return {"anyOf": [handler(schema), {"type": "string", "pattern": "^" + _FRACTION.pattern.replace(r"\Z", "$")}]}


def _check_order(value: tuple[float, float]) -> tuple[float, float]:
    if value[0] > value[1]:
        raise ValueError(f"the lower end {value[0]:g} is above the upper end {value[1]:g}; write [low, high]")
    return value


def _nonzero(message: str) -> AfterValidator:
    """Return a validator that refuses a vector of (almost) zero length."""

    def check(value: tuple[float, ...]) -> tuple[float, ...]:
        if math.hypot(*value) < 1e-6:
            raise ValueError(message)
        return value

    return AfterValidator(check)


def _text(number: float) -> str:
    """Return a number as text: all digits of a whole number with up to 20 digits."""
    return str(number) if isinstance(number, int) and abs(number) < 10**20 else f"{number:g}"


@dataclass(frozen=True)
class _Limits:
    """Annotation that refuses numbers outside of a range, because they would overflow in later computations.

    The reference pages do not list the range, because no sensible number is outside of it.
    """

    smallest: float
    largest: float

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        # an `AfterValidator` would take pydantic several times as long, to inspect the signature of each validator
        return core_schema.no_info_after_validator_function(self._check, handler(source))

    def _check(self, value: float) -> float:
        if not self.smallest <= value <= self.largest:
            allowed = f"{_text(self.smallest)} to {_text(self.largest)}"
            raise ValueError(f"{_text(value)} is out of range; allowed: {allowed}")
        return value


Number = Annotated[float, _FractionString(), _Limits(-1e38, 1e38)]
"""Finite number. This and all number types below, except those of whole numbers, also accept a fraction: `1/120`."""
Positive = Annotated[float, Field(gt=0), _FractionString(), _Limits(1e-38, 1e38)]
"""Number above 0."""
NotNegative = Annotated[float, Field(ge=0), _FractionString(), _Limits(0.0, 1e38)]
"""Number of at least 0."""
Seconds = Annotated[float, Field(gt=0), _FractionString(), _Limits(0.0, 1e9)]
"""Duration above 0 [s], at most 1e9, so that its number of environment steps fits 64 bits for every `sim.dt`."""
Count = Annotated[int, Field(ge=1), _Limits(1, 2**31 - 1)]
"""Whole number of at least 1."""
Length = Annotated[int, Field(ge=1), _Limits(1, 2**62)]
"""Number of steps or iterations of a training, 1 to 2**62."""
Width = Annotated[int, Field(ge=1, le=2**24)]
"""Number of units of a layer of a network."""
Widths = Annotated[tuple[Width, ...], Field(min_length=1, max_length=100)]
"""Widths of the layers of a network."""
Threads = Annotated[int, Field(ge=1, le=4096)]
"""Number of threads, 1 to 4096."""
Share = Annotated[float, Field(ge=0, le=1), _FractionString()]
"""Number from 0 to 1."""
Vec3 = tuple[Number, Number, Number]
"""Three numbers: x, y, z."""
Quaternion = Annotated[
    tuple[Number, Number, Number, Number],
    _nonzero("a quaternion must not be zero; no rotation is [1, 0, 0, 0]"),
]
"""Rotation (w, x, y, z), not zero."""
Direction = Annotated[Vec3, _nonzero("a direction must not be zero; straight down is [0, 0, -1]")]
"""Vector x, y, z that is not zero."""
Range = Annotated[tuple[Number, Number], AfterValidator(_check_order)]
"""Two numbers [low, high]; low is not above high."""
_SecondsOrZero = Annotated[float, Field(ge=0), _FractionString(), _Limits(0.0, 1e9)]
SecondsRange = Annotated[tuple[_SecondsOrZero, _SecondsOrZero], AfterValidator(_check_order)]
"""Two times of at least 0 [s], [low, high]."""
ShareRange = Annotated[tuple[Share, Share], AfterValidator(_check_order)]
"""Two numbers from 0 to 1, [low, high]."""
_Steps = Annotated[int, Field(ge=0, le=1000)]
StepRange = Annotated[tuple[Annotated[int, Field(ge=0)], _Steps], AfterValidator(_check_order)]
"""Two whole numbers [low, high], from 0 to 1000."""
Names = str | Annotated[list[str], Field(min_length=1)]
"""A name or regular expression, or a list of these."""


class StrictModel(BaseModel):
    """Base class of all configuration models: it refuses unknown keys, wrong types and NaN, and cannot be changed."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)
    _defined_in: ClassVar[ModuleType | None]

    def __init_subclass__(cls, **settings: Any) -> None:
        super().__init_subclass__(**settings)
        cls._defined_in = sys.modules.get(cls.__module__)

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Add the docstrings below the fields to the JSON Schema.

        The docstrings are read only when a schema is generated. Pydantic's `use_attribute_docstrings` reads them when
        the classes are created, which then takes 1.5 times as long.
        """
        from rlcli.config.docstrings import describe

        described = super().__get_pydantic_json_schema__(schema, handler)
        describe(handler.resolve_ref_schema(described), cls)
        return described

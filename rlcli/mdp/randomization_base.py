"""Base classes of randomisation terms, which draw values relative to the original ones and write them to the model."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, TypeAlias

import mujoco
import torch
from torch import Tensor

from rlcli.errors import listing
from rlcli.mdp.parameter_types import Entity
from rlcli.mdp.term import Term
from rlcli.mdp.term_helpers import column_numbers
from rlcli.scene.model_fields import ModelField
from rlcli.scene.names import NameProblem, match
from rlcli.sim.env_selection import Columns, Selection
from rlcli.sim.rotations import from_euler, multiply

SMALLEST = 1e-9
"""Lower bound of quantities that must be positive."""
Pair: TypeAlias = Sequence[float] | Tensor
"""Range of a term: two numbers; if a curriculum changes the range, the tensor (2,) that it writes to."""


class Ranges:
    """Lower and upper ends of several ranges as tensors; a curriculum may change the ranges between calls of `now`."""

    def __init__(self, device: torch.device, *pairs: Pair) -> None:
        self._fixed = _table(device, *((0.0, 0.0) if isinstance(pair, Tensor) else tuple(pair) for pair in pairs))
        self._tunable = [pair if isinstance(pair, Tensor) else None for pair in pairs]
        self._any_tunable = any(pair is not None for pair in self._tunable)

    def now(self) -> tuple[Tensor, Tensor]:
        """Return the current lower and upper ends. (ranges,) float32 each"""
        ends = self._fixed
        if self._any_tunable:
            rows = zip(self._fixed, self._tunable, strict=True)
            ends = torch.stack([row if tunable is None else tunable for row, tunable in rows])
        return ends[:, 0], ends[:, 1]


@functools.lru_cache(maxsize=1024)
def _table(device: torch.device, *pairs: tuple[float, float]) -> Tensor:
    """Return the ends of the ranges as a tensor. (ranges, 2)

    The tensor is cached, because a step that is captured as a CUDA graph must not create tensors.
    """
    return torch.tensor(pairs, dtype=torch.float32, device=device)


class Draw:
    """Sampler of new values: a distribution, and how a sample combines with the original value.

    Args:
        term: the term that has the keys `distribution`, `operation` and `shared`.
        range: one pair for all axes, or one pair for each: [low, high], or [mean, std] of a gaussian.
        shape: number of elements, and number of axes of each.
        lowest: lower bound of the new values.

    Raises:
        NameProblem: for a range that does not fit the distribution, or another number of ranges than axes.
    """

    def __init__(
        self, term: DrawingTerm, range: Pair | Sequence[Pair], shape: tuple[int, int], lowest: float | None = None
    ) -> None:
        many = range.dim() == 2 if isinstance(range, Tensor) else isinstance(range, list)
        pairs: list[Pair] = list(range) if many else [range]  # type: ignore
        if len(pairs) not in (1, shape[1]):
            raise NameProblem(f"range has {len(pairs)} pairs for {shape[1]} axes", "give 1 pair, or 1 per axis")
        _check(pairs, term.distribution)
        self._ranges = Ranges(term.env.device, *pairs)
        self._distribution, self._operation = term.distribution, term.operation
        self._shape = shape
        self._sample_shape = (1 if term.shared else shape[0], shape[1])
        self._lowest = lowest

    def __call__(self, selection: Selection, original: Tensor) -> Tensor:
        """Return new values of the selected environments. original (elements, axes) -> (rows, elements, axes)"""
        drawn = self.sample(selection)
        if self._operation == "set":
            new = drawn.expand(-1, *self._shape)
        else:
            new = original + drawn if self._operation == "add" else original * drawn
        return new if self._lowest is None else new.clamp(min=self._lowest)

    def sample(self, selection: Selection) -> Tensor:
        """Return samples of the distribution. (rows, elements, axes), with 1 in place of elements if `shared`"""
        first, second = self._ranges.now()
        if self._distribution == "gaussian":
            return selection.normal(first, second, self._sample_shape)
        if self._distribution == "uniform":
            return selection.uniform(first, second, self._sample_shape)
        return torch.exp(selection.uniform(torch.log(first), torch.log(second), self._sample_shape))


class DrawingTerm(Term):
    """Base class of terms that draw values relative to the original ones, with the settings that `Draw` reads.

    A subclass that declares one of these settings as a field has it as a key in the YAML; otherwise the class attribute
    below applies.
    """

    entity: Entity
    distribution: str
    operation: str = "scale"
    shared: bool = False


class FieldRandomization(DrawingTerm):
    """Base class of terms that draw values of one field of MjModel for the selected elements (bodies, geoms, ...)."""

    model_field: str
    """Name of the field in MjModel."""
    lowest: float | None = None
    """Lower bound of the new values."""
    same_for_axes: bool = False
    """Whether all axes of an element get the same sample."""

    axes: list[int] | None = None
    range: Any

    def __post_init__(self) -> None:
        self.target = ModelField(self.entity, self.model_field, self.selected(), self.axes)
        self.derives = self.target.derives
        count, axes = self.target.shape
        shape = (count, 1 if self.same_for_axes else axes)
        self.draw = Draw(self, self.range, shape, self.lowest)

    def __call__(self, selection: Selection) -> None:
        """Draw new values for the selected environments."""
        self.target.write(selection, self.draw(selection, self.target.original))


@dataclass(kw_only=True, eq=False)
class DrawKeys(DrawingTerm):
    """Base class of terms with the keys `distribution`, `operation` and `shared`."""

    distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform"
    operation: Literal["add", "scale", "set"] = "scale"
    shared: bool = False


@dataclass(kw_only=True, eq=False)
class RangeKeys(DrawKeys):
    """Base class of terms that draw from one range."""

    range: tuple[float, float]


class Randomization(RangeKeys, FieldRandomization):
    """Base class of terms that draw all values of an element (a body, geom, joint ...) from the same range."""


@dataclass(kw_only=True, eq=False)
class AxisRandomization(DrawKeys, FieldRandomization):
    """Base class of terms that draw some components (axes) of an element's vector, such as the z of a position.

    `range` is one range for all these axes, or a list with one range for each axis.
    """

    axes: list[int] | None = None
    range: tuple[float, float] | list[tuple[float, float]]
    operation: Literal["add", "scale", "set"] = "add"


@dataclass(kw_only=True, eq=False)
class OrientationRandomization(DrawingTerm):
    """Base class of terms that turn the quaternions of a model field."""

    model_field: ClassVar[str]
    """Name of the field in MjModel."""
    operation = "set"

    roll: tuple[float, float] = (0.0, 0.0)
    pitch: tuple[float, float] = (0.0, 0.0)
    yaw: tuple[float, float] = (0.0, 0.0)
    distribution: Literal["uniform", "gaussian"] = "uniform"
    shared: bool = False

    def __post_init__(self) -> None:
        self.target = ModelField(self.entity, self.model_field, self.selected())
        self.derives = self.target.derives
        self._draw = Draw(self, [self.roll, self.pitch, self.yaw], (self.target.shape[0], 3))

    def __call__(self, selection: Selection) -> None:
        """Draw new orientations for the selected environments."""
        turn = from_euler(*self._draw.sample(selection).to(self.target.original.dtype).unbind(2))
        original = self.target.original.expand(len(turn), -1, -1)
        # the original comes first: the element turns about its own axes
        self.target.write(selection, multiply(original, turn.expand(-1, original.shape[1], -1)))


def matching_elements(elements: list[Any], params: dict[str, Any], key: str, kind: str) -> list[Any]:
    """Return the elements of the MjSpec that a term selects; an empty list if a pattern is wrong.

    A wrong pattern is reported later, when the term is created for the compiled model.

    Args:
        elements: all elements of a kind, such as `spec.bodies`.
        params: parameters of the term.
        key: the parameter with the names or patterns, such as `bodies`.
        kind: name of an element for messages, such as `body`.
    """
    prefix = f"{params['entity']}/"
    of_entity = [element for element in elements if element.name.startswith(prefix)]
    try:
        found = match(params[key], [element.name.removeprefix(prefix) for element in of_entity], kind)
    except NameProblem:
        return []
    return [of_entity[position] for position in found]


def unset_simple(spec: mujoco.MjSpec, params: dict[str, Any], key: str) -> None:
    """Clear MuJoCo's `simple` flag of bodies; with the flag, MuJoCo takes the body's frame as the inertial frame.

    Args:
        spec: the model.
        params: parameters of the term.
        key: the parameter with the names or patterns of the bodies.
    """
    for body in matching_elements(spec.bodies, params, key, "body"):
        body.simple = 0


def element_names(entity: Any, kind: str, index: Columns) -> list[str]:
    """Return the names of an entity's elements (joints, bodies, ...) that an index selects."""
    names = entity.names[kind]
    return [names[number] for number in column_numbers(index, len(names))]


def require_supported(
    entity: Entity, kind: str, index: Columns, supported: list[bool], problem: str, hint: str
) -> None:
    """Check that every selected element can be randomised.

    Args:
        entity: the entity.
        kind: kind of element, such as `Actuators`.
        index: index of the selected elements.
        supported: whether an element can be randomised, for each element of this kind.
        problem: property of an element that cannot be randomised, for the message, such as `without kp`.
        hint: what the user can do.

    Raises:
        NameProblem: with the names of the elements that cannot be randomised, and of the elements that can.
    """
    able = dict(zip(entity.names[kind], supported, strict=True))
    bad = [name for name in element_names(entity, kind, index) if not able[name]]
    if bad:
        can = [name for name, fine in able.items() if fine]
        message = f"the term cannot change {kind.lower()} {problem}: {listing(bad)}"
        raise NameProblem(message, f"{hint}; {kind.lower()} of '{entity.name}' that work: {listing(can)}")


def _check(pairs: list[Pair], distribution: str) -> None:
    for pair in pairs:
        first, second = pair.tolist() if isinstance(pair, Tensor) else pair
        if distribution == "gaussian" and second < 0:
            raise NameProblem(f"gaussian: the standard deviation {second:g} is negative", "write [mean, std]")
        if distribution != "gaussian" and first > second:
            raise NameProblem(f"the lower end {first:g} is above the upper end {second:g}", "write [low, high]")
        if distribution == "loguniform" and first <= 0:
            raise NameProblem(f"loguniform needs a range above 0, found {first:g}", "use uniform for other ranges")

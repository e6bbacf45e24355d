"""What terms of randomisation have in common: values drawn about the original ones, and where they go."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch
from torch import Tensor

from rlcli.errors import listing
from rlcli.mdp.parameters import Entity
from rlcli.mdp.ranges import Pair, Ranges
from rlcli.mdp.term import Term
from rlcli.scene.model_fields import ModelField
from rlcli.scene.names import NameProblem, match
from rlcli.sim.rotations import from_euler, multiply
from rlcli.sim.selection import Columns, Selection

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv

SMALLEST = 1e-9
"""Lower bound of quantities that must be positive."""


class Draw:
    """Values about the original ones, by distribution and operation.

    Raises:
        ValueError: for a range that the distribution cannot have.
    """

    def __init__(
        self,
        env: ManagedEnv,
        range: Pair | Sequence[Pair],
        distribution: str,
        operation: str,
        shape: tuple[int, int],
        *,
        shared: bool = False,
        lowest: float | None = None,
    ) -> None:
        many = range.dim() == 2 if isinstance(range, Tensor) else isinstance(range, list)
        pairs: list[Pair] = list(range) if many else [range]  # type: ignore
        if len(pairs) not in (1, shape[1]):
            raise NameProblem(f"range has {len(pairs)} pairs for {shape[1]} axes", "one pair for all, or one for each")
        _check(pairs, distribution)
        self._ranges = Ranges(env.device, *pairs)
        self._distribution, self._operation = distribution, operation
        self._shape = shape
        self._drawn = (1 if shared else shape[0], shape[1])
        self._lowest = lowest

    def __call__(self, selection: Selection, original: Tensor) -> Tensor:
        """New values of the selected environments. original (elements, axes) -> (rows, elements, axes)"""
        drawn = self.sample(selection)
        if self._operation == "set":
            new = drawn.expand(-1, *self._shape)
        else:
            new = original + drawn if self._operation == "add" else original * drawn
        return new if self._lowest is None else new.clamp(min=self._lowest)

    def sample(self, selection: Selection) -> Tensor:
        """The draws alone. (rows, elements or 1, axes)"""
        first, second = self._ranges.now()
        if self._distribution == "gaussian":
            return selection.normal(first, second, self._drawn)
        if self._distribution == "uniform":
            return selection.uniform(first, second, self._drawn)
        return torch.exp(selection.uniform(torch.log(first), torch.log(second), self._drawn))


class DrawingTerm(Term):
    """Base of terms that draw values about the original ones.

    A term is a dataclass whose fields are the keys to draw by; a key that it does not have keeps the value below.
    """

    entity: Entity
    distribution: str
    operation: str = "scale"
    shared: bool = False

    def new_draw(self, range: Pair | Sequence[Pair], shape: tuple[int, int], lowest: float | None = None) -> Draw:
        """Return the draw of values of a shape (elements, axes), as the keys of the term say."""
        return Draw(self.env, range, self.distribution, self.operation, shape, shared=self.shared, lowest=lowest)


class FieldRandomization(DrawingTerm):
    """Base of terms that draw for some elements of one model field."""

    model_field: str
    """The model's field."""
    lowest: float | None = None
    """Lower bound of the new values."""
    same_for_axes: bool = False
    """Whether all axes of an element get one draw."""

    axes: list[int] | None = None
    range: Any

    def __post_init__(self) -> None:
        self.target = ModelField(self.entity, self.model_field, self.selected(), self.axes)
        self.derives = self.target.derives
        count, axes = self.target.shape
        shape = (count, 1 if self.same_for_axes else axes)
        self.draw = self.new_draw(self.range, shape, self.lowest)

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        self.target.write(selection, self.draw(selection, self.target.original))


@dataclass(kw_only=True, eq=False)
class RangeKeys(DrawingTerm):
    """The keys of a draw with one range."""

    range: tuple[float, float]
    distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform"
    operation: Literal["add", "scale", "set"] = "scale"
    shared: bool = False


class Randomization(RangeKeys, FieldRandomization):
    """Base of terms that draw one number, or several by the same range, for each element."""


@dataclass(kw_only=True, eq=False)
class AxisRandomization(FieldRandomization):
    """Base of terms that draw for the axes of each element, by one range or by one for each axis."""

    axes: list[int] | None = None
    range: tuple[float, float] | list[tuple[float, float]]
    distribution: Literal["uniform", "loguniform", "gaussian"] = "uniform"
    operation: Literal["add", "scale", "set"] = "add"
    shared: bool = False


@dataclass(kw_only=True, eq=False)
class OrientationRandomization(DrawingTerm):
    """Base of terms that draw for some elements of a field of quaternions."""

    model_field: ClassVar[str]
    """The model's field."""
    operation = "set"

    roll: tuple[float, float] = (0.0, 0.0)
    pitch: tuple[float, float] = (0.0, 0.0)
    yaw: tuple[float, float] = (0.0, 0.0)
    distribution: Literal["uniform", "gaussian"] = "uniform"
    shared: bool = False

    def __post_init__(self) -> None:
        self.target = ModelField(self.entity, self.model_field, self.selected())
        self.derives = self.target.derives
        self._draw = self.new_draw([self.roll, self.pitch, self.yaw], (self.target.shape[0], 3))

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        turn = from_euler(*self._draw.sample(selection).to(self.target.original.dtype).unbind(2))
        original = self.target.original.expand(len(turn), -1, -1)
        self.target.write(selection, multiply(original, turn.expand(-1, original.shape[1], -1)))


def matching_elements(elements: list[Any], params: dict[str, Any], key: str, what: str) -> list[Any]:
    """Return the elements of the scene that a term's patterns match, or none: binding the term reports the problem."""
    prefix = f"{params['entity']}/"
    of_entity = [element for element in elements if element.name.startswith(prefix)]
    try:
        found = match(params[key], [element.name.removeprefix(prefix) for element in of_entity], what)
    except NameProblem:
        return []
    return [of_entity[position] for position in found]


def on_host(index: Columns) -> Columns:
    """Return an index of elements that tensors on the CPU can be read with."""
    return index.cpu() if isinstance(index, Tensor) else index


def element_names(entity: Any, kind: str, index: Columns) -> list[str]:
    """Return the names of the selected elements."""
    names = entity.names[kind]
    return [names[i] for i in torch.arange(len(names))[on_host(index)].tolist()]


def require_able(entity: Entity, kind: str, index: Columns, good: list[bool], problem: str, hint: str) -> None:
    """Check that every selected element can be randomised.

    Raises:
        NameProblem: with the names of the elements that cannot.
    """
    able = dict(zip(entity.names[kind], good, strict=True))
    bad = [name for name in element_names(entity, kind, index) if not able[name]]
    if bad:
        can = [name for name, fine in able.items() if fine]
        raise NameProblem(f"{listing(bad)} {problem}", f"{hint}; of '{entity.name}' these do: {listing(can) or 'none'}")


def _check(pairs: list[Pair], distribution: str) -> None:
    for pair in (pair.tolist() if isinstance(pair, Tensor) else pair for pair in pairs):
        for first, second in (pair,):
            if distribution == "gaussian" and second < 0:
                raise NameProblem(f"gaussian: the standard deviation {second:g} is negative", "range is [mean, std]")
            if distribution != "gaussian" and first > second:
                raise NameProblem(f"the lower end {first:g} is above the upper end {second:g}", "range is [low, high]")
            if distribution == "loguniform" and first <= 0:
                raise NameProblem(f"loguniform needs a range above 0, not one from {first:g}", "uniform takes any")

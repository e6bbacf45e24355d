"""What terms of randomisation have in common: values drawn about the original ones, and where they go."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from rlcli.mdp.ranges import Pair, Ranges
from rlcli.sim.model_fields import ModelField
from rlcli.sim.names import NameProblem
from rlcli.sim.rotations import from_euler, multiply
from rlcli.sim.selection import Columns, Selection

if TYPE_CHECKING:
    from rlcli.envs.managed import ManagedEnv


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


class Randomization:
    """Draws for some elements of one model field."""

    def __init__(
        self,
        env: ManagedEnv,
        entity: Any,
        field: str,
        elements: Columns | None,
        range: Pair | Sequence[Pair],
        distribution: str,
        operation: str,
        shared: bool = False,
        axes: list[int] | None = None,
        lowest: float | None = None,
        alike: bool = False,
    ) -> None:
        self.field = ModelField(entity, field, elements, axes)
        self.derives = self.field.derives
        shape = (self.field.shape[0], 1) if alike else self.field.shape
        self.draw = Draw(env, range, distribution, operation, shape, shared=shared, lowest=lowest)

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        self.field.write(selection, self.draw(selection, self.field.original))


class Turn:
    """Draws for some elements of a field of quaternions."""

    def __init__(
        self,
        env: ManagedEnv,
        entity: Any,
        field: str,
        elements: Columns,
        angles: list[Pair],
        distribution: str,
        shared: bool,
    ) -> None:
        self.field = ModelField(entity, field, elements)
        self.derives = self.field.derives
        self._draw = Draw(env, angles, distribution, "set", (self.field.shape[0], 3), shared=shared)

    def __call__(self, selection: Selection) -> None:
        """Draw anew for the selected environments."""
        turn = from_euler(*self._draw.sample(selection).to(self.field.original.dtype).unbind(2))
        original = self.field.original.expand(len(turn), -1, -1)
        self.field.write(selection, multiply(original, turn.expand(-1, original.shape[1], -1)))


def _check(pairs: list[Pair], distribution: str) -> None:
    for pair in (pair.tolist() if isinstance(pair, Tensor) else pair for pair in pairs):
        for first, second in (pair,):
            if distribution == "gaussian" and second < 0:
                raise NameProblem(f"gaussian: the standard deviation {second:g} is negative", "range is [mean, std]")
            if distribution != "gaussian" and first > second:
                raise NameProblem(f"the lower end {first:g} is above the upper end {second:g}", "range is [low, high]")
            if distribution == "loguniform" and first <= 0:
                raise NameProblem(f"loguniform needs a range above 0, not one from {first:g}", "uniform takes any")

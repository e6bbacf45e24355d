"""Actions: the policy's vector is cut into terms, each turns its part into controls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from rlcli.errors import ConfigError
from rlcli.managers.term import BoundTerm, resets
from rlcli.sim.selection import Field, Selection, in_place
from rlcli.sim.tensor_state import TensorState


@dataclass(frozen=True, slots=True)
class CommandMap:
    """How a term turns its columns into commands: raw x scale + offset, then clip, then the actuators' own limits."""

    scale: tuple[float, ...]
    """One a column."""
    offset: tuple[float, ...]
    """One a column, in the command's unit."""
    clip: tuple[tuple[float, float], ...] | None
    """The term's own limits of each column, in the command's unit."""
    limits: tuple[tuple[float, float], ...]
    """What each column's actuator can take, in the command's unit; infinite where it has no limit."""


class ActionTerm(Protocol):
    """An action term is a class `Name(env, *, ...)`.

    A term whose command is a scaled and clipped action says so in a method `command_map() -> CommandMap`; exported
    policies then contain it.
    """

    size: int
    """Columns of the policy's vector that it takes."""
    elements: tuple[str, ...]
    """What the columns drive, in order."""
    unit: str
    """Unit of the command that reaches the actuators."""

    def process(self, action: Tensor) -> None:
        """Take this step's columns and write the controls. (num_envs, size)"""
        ...


class ActionManager(TensorState):
    """Keeps the raw actions of this step and the last, and hands each term its columns."""

    def __init__(
        self, terms: list[BoundTerm], num_envs: int, device: torch.device, as_field: Callable[[Tensor], Field]
    ) -> None:
        self.terms = terms
        _refuse_shared(terms)
        self.size = sum(term.instance.size for term in terms)
        self._forget = resets(terms)
        both = torch.zeros(2, num_envs, self.size, device=device)
        self._both_by_env = as_field(both.transpose(0, 1))
        self.action = both[0]
        """The policy's action of this step. (num_envs, size)"""
        self.prev_action = both[1]
        """That of the step before; zero at the start of an episode. (num_envs, size)"""
        self._last, self._now = in_place(self.prev_action), in_place(self.action)
        self._process = []
        start = 0
        for term in terms:
            self._process.append((term.instance.process, self.action[:, start : start + term.instance.size]))
            start += term.instance.size

    def process(self, action: Tensor) -> None:
        """Take one step's action."""
        self._last[...] = self._now
        self.action.copy_(action)
        for process, columns in self._process:
            process(columns)

    def reset(self, selection: Selection) -> None:
        """New episodes begin without a past action."""
        selection.write(self._both_by_env, 0.0)
        for reset in self._forget:
            reset(selection)

    def tensors(self) -> dict[str, Tensor]:
        """Return both actions."""
        return {"action": self.action, "prev_action": self.prev_action}


def _refuse_shared(terms: list[BoundTerm]) -> None:
    """Of two terms that write one actuator only the later would count.

    Raises:
        ConfigError: naming both terms and what they share.
    """
    owner: dict[int | str, BoundTerm] = {}
    for term in terms:
        for sink, element in zip(getattr(term.instance, "sinks", ()), term.instance.elements, strict=False):
            first = owner.setdefault(sink, term)
            if first is not term:
                message = f"'{element}' is driven by '{first.name}' already"
                raise ConfigError([term.resolved.problem(term.path, message)])

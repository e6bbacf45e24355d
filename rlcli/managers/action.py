"""Manager of the action terms. Each term turns its columns of the policy's action into controls of actuators."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from rlcli.errors import ConfigError
from rlcli.managers.observation_stages import Delay, make_delay
from rlcli.managers.term_binding import BoundTerm, EnvContext, resets
from rlcli.sim.env_selection import Selection, in_place
from rlcli.sim.saved_tensors import TensorState


@dataclass(frozen=True, slots=True)
class CommandMap:
    """Formula of the commands that an action term sends to actuators, one command for each column of the action.

    command = action x scale + offset, clipped to `clip`, then to `limits`.
    """

    scale: tuple[float, ...]
    """Factor on each column of the action."""
    offset: tuple[float, ...]
    """Number that is added to each scaled column, in the command's unit."""
    clip: tuple[tuple[float, float], ...] | None
    """The term's own limits of each column, in the command's unit; None: no limits."""
    limits: tuple[tuple[float, float], ...]
    """Limits of each column's actuator, in the command's unit; infinite for an actuator without a limit."""


class ActionTerm(Protocol):
    """Interface of an action term: a class `Name(env, *, ...)` whose keyword arguments are the term's keys in the YAML.

    A term whose command is a scaled and clipped action may have a method `command_map() -> CommandMap`. Exported
    policies then contain the formula. A term may have `sinks`, the actuator of each column: two terms with the same
    actuator are an error.
    """

    size: int
    """Number of columns of the policy's action that the term uses."""
    elements: tuple[str, ...]
    """Name of the joint or axis that each column drives."""
    unit: str
    """Unit of the command to the actuators."""

    def process(self, action: Tensor) -> None:
        """Write the actuator controls for the term's columns of this step's action. action (num_envs, size)"""


class ActionManager(TensorState):
    """Manager of the action terms, with the raw actions of the current and the previous step."""

    def __init__(self, terms: list[BoundTerm], context: EnvContext) -> None:
        self.terms = terms
        self._select_all = context.select_all
        _require_separate_actuators(terms)
        self.size = sum(term.instance.size for term in terms)
        self._term_resets = resets(terms)
        both = torch.zeros(2, context.num_envs, self.size, device=context.device)
        self._both_by_env = context.engine.as_field(both.transpose(0, 1))
        self.action = both[0]
        """The policy's action of this step. (num_envs, size)"""
        self.prev_action = both[1]
        """The action of the previous step; zero at the start of an episode. (num_envs, size)"""
        self._previous, self._current = in_place(self.prev_action), in_place(self.action)
        self._process = []
        self._delays: dict[str, Delay] = {}
        start = 0
        for term in terms:
            size = term.instance.size
            delay = make_delay(term, size, context)
            if delay is not None:
                self._delays[term.name] = delay
            self._process.append((term.instance.process, self.action[:, start : start + size], delay))
            start += size

    def process(self, action: Tensor) -> None:
        """Store the action of this step and let each term process its columns. action (num_envs, size)"""
        self._previous[...] = self._current  # first: the current action is overwritten next
        self.action.copy_(action)
        for process, columns, delay in self._process:
            if delay is None:
                process(columns)
                continue
            delayed = columns.clone()
            delay(delayed, self._draws, None, True)
            process(delayed)

    def reset(self, selection: Selection) -> None:
        """Set the actions of new episodes to zero, and reset the terms."""
        selection.write(self._both_by_env, 0.0)
        for reset in self._term_resets:
            reset(selection)
        for delay in self._delays.values():
            delay.empty(selection)

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors to save: the actions of this step and of the previous one, and delayed values, by name."""
        delays = self._delays.items()
        memories = {f"{name}.{key}": tensor for name, delay in delays for key, tensor in delay.tensors().items()}
        return {"action": self.action, "prev_action": self.prev_action, **memories}

    def _draws(self, stream: np.uint64) -> Selection:
        return self._select_all().stream(stream)


def _require_separate_actuators(terms: list[BoundTerm]) -> None:
    """Check that no two terms write to the same actuator: the later term would overwrite the controls of the earlier.

    Raises:
        ConfigError: with both terms and the element that they share.
    """
    owner: dict[int | str, BoundTerm] = {}
    for term in terms:
        for sink, element in zip(getattr(term.instance, "sinks", ()), term.instance.elements, strict=False):
            first = owner.setdefault(sink, term)
            if first is not term:
                message = f"the action '{first.name}' drives '{element}' already; remove one of the two actions"
                raise ConfigError([term.resolved.problem(term.path, message)])

"""Curriculum: what changes while training goes on, by the clock of training or by how episodes went."""

from __future__ import annotations

import torch
from torch import Tensor

from rlcli.managers.term import BoundTerm
from rlcli.managers.tunable import TunableValues
from rlcli.sim.selection import Selection
from rlcli.sim.tensor_state import TensorState


class CurriculumManager(TensorState):
    """A term is called with the environments whose episode ends, before anything of it is forgotten.

    It is a function `name(env, selection, *, ...)` or a class; a class may have a method `advance(step)` instead, which
    is called once a step with the number of steps so far, so that a schedule does not depend on who resets when.
    Either may give a number to log, `()` or (num_envs,), of which the mean is logged.
    """

    def __init__(self, terms: list[BoundTerm], tunable: TunableValues, device: torch.device) -> None:
        self.terms = terms
        self._tunable = tunable
        self._scheduled = [term for term in terms if hasattr(term.instance, "advance")]
        self._per_episode = [term for term in terms if not hasattr(term.instance, "advance")]
        self._values = {term.name: torch.full((), torch.nan, device=device) for term in terms}

    def advance(self, step: Tensor) -> None:
        """Advance schedules to a step. step () int64"""
        for term in self._scheduled:
            self._keep(term, term.instance.advance(step))

    def compute(self, ended: Selection) -> None:
        """Call the terms that look at episodes, with those that end."""
        for term in self._per_episode:
            self._keep(term, term.call(ended.stream(term.stream)))

    def values(self) -> dict[str, float]:
        """What the terms gave last, by name."""
        return {f"Curriculum/{name}": float(value) for name, value in self._values.items()}

    def tensors(self) -> dict[str, Tensor]:
        """Return the tunable values, and those last logged."""
        logged = {f"value.{name}": value for name, value in self._values.items()}
        return {**logged, **{f"live.{path}": value for path, value in self._tunable.tensors().items()}}

    def _keep(self, term: BoundTerm, value: Tensor | float | None) -> None:
        if isinstance(value, Tensor):
            self._values[term.name].copy_(value.float().mean() if value.dim() else value)
        elif value is not None:
            self._values[term.name].fill_(value)

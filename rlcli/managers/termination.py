"""Terminations: which episodes end, whether because of the task or of the clock, and which terms said so."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from rlcli.managers.term import BoundTerm, check_shape, first_value, resets
from rlcli.sim.selection import Selection

DIVERGED = "diverged"
"""Name under which a diverged simulation is logged as a cause."""


class TerminationManager:
    """`terminated` and `time_outs` are those of the current step; a state may be both."""

    def __init__(self, terms: list[BoundTerm], num_envs: int, device: torch.device) -> None:
        self.terms = terms
        self._none = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self.terminated = self._none.clone()
        """(num_envs,) bool"""
        self.time_outs = self._none.clone()
        """(num_envs,) bool"""
        self.fired: dict[str, Tensor] = {term.name: self._none for term in terms}
        """Term -> where it fired in this step. (num_envs,) bool each"""
        self._forget = resets(terms)
        self._calls = [(term, bool(term.config.time_out)) for term in terms]  # type: ignore[attr-defined]
        for term in terms:
            check_shape(term, first_value(term), (num_envs,))

    def compute(self, diverged: Tensor | None) -> tuple[Tensor, Tensor]:
        """Judge this step. (num_envs,) bool each"""
        self.fired = {} if diverged is None else {DIVERGED: diverged}
        failed: list[Tensor] = list(self.fired.values())
        timed_out: list[Tensor] = []
        for term, is_time_out in self._calls:
            fired = self.fired[term.name] = term.call()
            (timed_out if is_time_out else failed).append(fired)
        self.terminated, self.time_outs = self._any(failed), self._any(timed_out)
        return self.terminated, self.time_outs

    def _any(self, masks: list[Tensor]) -> Tensor:
        if len(masks) < 2:  # a copy: a term may keep its own tensor from step to step
            return masks[0].clone() if masks else self._none.clone()
        return functools.reduce(torch.logical_or, masks)

    def causes(self, ended: Selection) -> dict[str, Tensor]:
        """Term -> whether it fired where episodes ended. (n,) bool each"""
        return {name: ended.read_view(fired) for name, fired in self.fired.items()}

    def reset(self, selection: Selection) -> None:
        """Tell terms with memory."""
        for reset in self._forget:
            reset(selection)

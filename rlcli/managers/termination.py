"""Terminations: which episodes end, whether because of the task or of the clock, and which terms said so."""

from __future__ import annotations

import torch
from torch import Tensor

from rlcli.managers.term import BoundTerm, check_shape, first_value
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
        for term in terms:
            check_shape(term, first_value(term), (num_envs,), "terminations")

    def compute(self, diverged: Tensor | None) -> tuple[Tensor, Tensor]:
        """Judge this step. (num_envs,) bool each"""
        terminated = self._none.clone() if diverged is None else diverged.clone()
        time_outs = self._none.clone()
        self.fired = {} if diverged is None else {DIVERGED: diverged}
        for term in self.terms:
            fired = self.fired[term.name] = term.call()
            if term.config.time_out:  # type: ignore[attr-defined]
                time_outs |= fired
            else:
                terminated |= fired
        self.terminated, self.time_outs = terminated, time_outs
        return terminated, time_outs

    def causes(self, ended: Selection) -> dict[str, Tensor]:
        """Term -> whether it fired where episodes ended. (n,) bool each"""
        return {name: ended.read(fired) for name, fired in self.fired.items()}

    def reset(self, selection: Selection) -> None:
        """Tell terms with memory."""
        for term in self.terms:
            term.reset(selection)

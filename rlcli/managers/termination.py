"""Manager of the termination terms: which episodes end, by failure or by time-out, and which terms fired."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from rlcli.managers.term_binding import BoundTerm, CheckedTerm, EnvContext, first_value, resets
from rlcli.sim.env_selection import Selection

DIVERGED = "diverged"
"""Cause that is logged for an episode whose simulation diverged."""


class TerminationManager:
    """Manager of the termination terms. A state may be both terminated and timed out."""

    def __init__(self, terms: list[BoundTerm], context: EnvContext) -> None:
        self.terms = terms
        self._none = torch.zeros(context.num_envs, dtype=torch.bool, device=context.device)
        self.terminated = self._none.clone()
        """Where this step terminated the episode. (num_envs,) bool"""
        self.time_outs = self._none.clone()
        """Where the episode timed out in this step. (num_envs,) bool"""
        self.fired: dict[str, Tensor] = {term.name: self._none for term in terms}
        """Term name -> where the term fired in this step. (num_envs,) bool each"""
        self._term_resets = resets(terms)
        self._calls = [
            (term.name, CheckedTerm(term, first_value(term), (context.num_envs,), is_mask=True), _is_time_out(term))
            for term in terms
        ]

    def compute(self, diverged: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return where this step terminates episodes, and where episodes time out. (num_envs,) bool each

        Args:
            diverged: where the simulation diverged, which terminates the episode, (num_envs,) bool; None: nowhere.
        """
        self.fired = {} if diverged is None else {DIVERGED: diverged}
        failed: list[Tensor] = list(self.fired.values())
        timed_out: list[Tensor] = []
        for name, call, is_time_out in self._calls:
            fired = self.fired[name] = call()
            (timed_out if is_time_out else failed).append(fired)
        self.terminated, self.time_outs = self._any(failed), self._any(timed_out)
        return self.terminated, self.time_outs

    def _any(self, masks: list[Tensor]) -> Tensor:
        if len(masks) < 2:  # copy: a term may return the same tensor in each step
            return masks[0].clone() if masks else self._none.clone()
        return functools.reduce(torch.logical_or, masks)

    def causes(self, ended: Selection) -> dict[str, Tensor]:
        """Return term name -> whether the term fired in the last step of the episodes that end. (n,) bool each"""
        return {name: ended.read_view(fired) for name, fired in self.fired.items()}

    def reset(self, selection: Selection) -> None:
        """Reset the terms that keep values from step to step."""
        for reset in self._term_resets:
            reset(selection)


def _is_time_out(term: BoundTerm) -> bool:
    return bool(term.config.time_out)  # type: ignore[attr-defined]

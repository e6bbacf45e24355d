"""Manager of the reward terms. The reward of a step is the sum of weight x value x step_dt over the terms.

With `reward_dt_scaling: false` the factor step_dt is 1.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rlcli.managers.term_binding import BoundTerm, CheckedTerm, EnvContext, first_value, resets
from rlcli.managers.termination import DIVERGED
from rlcli.sim.env_selection import Selection, in_place
from rlcli.sim.saved_tensors import TensorState


class RewardManager(TensorState):
    """Manager of the reward terms. Terms with a constant weight of 0 are not called.

    The task's `divergence_reward`, the reward of a step in which the simulation diverges, is logged as one more term.
    """

    def __init__(
        self, terms: list[BoundTerm], context: EnvContext, dt: float, divergence_reward: float | None = None
    ) -> None:
        num_envs, device, as_field = context.num_envs, context.device, context.engine.as_field
        self.terms = terms
        self._term_resets = resets(terms)
        self._dt = dt
        weights = [context.tunable.get((*term.path, "weight"), term.config.weight) for term in terms]  # type: ignore[attr-defined]
        # at least two columns: numpy sums a single column in another order than several
        table = torch.zeros(len(terms), max(num_envs, 2), device=device)
        self._values = table[:, :num_envs]
        self._sums = torch.zeros(len(terms), num_envs, device=device)
        self._rows = list(self._values.unbind(0))
        factors = [0.0 if _is_tunable(weight) else weight * dt for weight in weights]
        self._factors = torch.tensor(factors, dtype=torch.float32, device=device)[:, None]
        kept = [term.config.while_alive for term in terms]  # type: ignore[attr-defined]
        self._while_alive = torch.tensor(kept, device=device)[:, None] if any(kept) else None
        self._divergence_reward = divergence_reward
        self._divergence_sums = torch.zeros(num_envs, device=device)
        self._tunable = [
            (factor, weight)
            for factor, weight in zip(self._factors.flatten().unbind(0), weights, strict=True)
            if _is_tunable(weight)
        ]
        totals = [torch.zeros(table.shape[1], device=device) for _ in range(3)]
        self._totals = [total[:num_envs] for total in totals]
        self._next = 0
        self._fused = device.type == "cuda"
        self._step_terms, self._episode_terms = in_place(self._values), in_place(self._sums)
        self._sums_by_env = as_field(self._sums.t())
        self._added, self._added_to = in_place(table), [in_place(total) for total in totals]
        self._active = [
            (CheckedTerm(term, first_value(term), (num_envs,)), row)
            for term, row, weight in zip(terms, self._rows, weights, strict=True)
            if _is_tunable(weight) or weight * dt != 0.0
        ]

    def compute(self, diverged: Tensor | None = None, terminated: Tensor | None = None) -> Tensor:
        """Return the reward of this step, without adding it to the sums of the episodes. (num_envs,)

        On a CPU terms are added one after the other, because the rounding of torch's sum over rows depends on the
        number of environments. On a GPU results are not bit-identical anyway.

        Args:
            diverged: where the simulation diverged, (num_envs,) bool; None: nowhere. On a CPU a term that is not finite
                counts as 0 there.
            terminated: where the episode is terminated, (num_envs,) bool; terms with `while_alive` count as 0 there.
        """
        for call, row in self._active:
            row.copy_(call())
        for factor, weight in self._tunable:
            torch.mul(weight, self._dt, out=factor)
        self._values *= self._factors
        if self._while_alive is not None and terminated is not None:
            self._values.masked_fill_(self._while_alive & terminated, 0.0)
        if diverged is not None and not self._fused:
            self._values.masked_fill_(diverged & ~self._values.isfinite(), 0.0)
        self._next = (self._next + 1) % len(self._totals)
        if self._fused:
            total = torch.sum(self._values, dim=0, out=self._totals[self._next])
        else:
            total = self._totals[self._next]
            np.add.reduce(self._added, axis=0, out=self._added_to[self._next])
        return total

    def add_to_episodes(self) -> None:
        """Add this step's terms to the sums of the running episodes."""
        self._episode_terms += self._step_terms

    @property
    def step_terms(self) -> Tensor:
        """Weighted value of each term in the last step; the next step overwrites it. (terms, num_envs)"""
        return self._values

    def values(self) -> dict[str, Tensor]:
        """Return the weighted value of each term in the last step, 0 for a term that is not called. (num_envs,) each"""
        return {term.name: row for term, row in zip(self.terms, self._rows, strict=True)}

    def replace_diverged(self, diverged: Tensor, total: Tensor) -> None:
        """Replace the reward of this step by the task's `divergence_reward` in diverged environments.

        Without a `divergence_reward` nothing changes.

        Args:
            diverged: where the simulation diverged. (num_envs,) bool
            total: reward of the step, changed in place. (num_envs,)
        """
        if self._divergence_reward is None:
            return
        self._sums -= torch.where(diverged, self._values, 0.0)
        self._divergence_sums += diverged * self._divergence_reward
        total.masked_fill_(diverged, self._divergence_reward)

    def episode(self, ended: Selection) -> tuple[Tensor, dict[str, Tensor]]:
        """Return (returns, term name -> its part of the return) of the episodes that end. (n,) each"""
        sums = ended.read(self._sums_by_env).contiguous()  # so that rounding does not depend on the number of rows
        shares = {term.name: column for term, column in zip(self.terms, sums.unbind(1), strict=True)}
        returns = sums.sum(dim=1)
        if self._divergence_reward is not None:
            shares[DIVERGED] = ended.read(self._divergence_sums)
            returns += shares[DIVERGED]
        return returns, shares

    def require_finite_terms(self) -> None:
        """Check that the terms of the last step are finite.

        Raises:
            DivergedError: with the first term that is not finite.
        """
        for term, row in zip(self.terms, self._rows, strict=True):
            term.require_finite(row, f"reward term '{term.name}'")

    def reset(self, selection: Selection) -> None:
        """Set the episode sums of new episodes to zero."""
        selection.write(self._sums_by_env, 0.0)
        if self._divergence_reward is not None:
            selection.write(self._divergence_sums, 0.0)
        for reset in self._term_resets:
            reset(selection)

    def tensors(self) -> dict[str, Tensor]:
        """Return the sums of the reward terms over the running episodes, by name."""
        return {"sums": self._sums, "divergence_sums": self._divergence_sums}


def _is_tunable(weight: float | Tensor) -> bool:
    """Return whether a curriculum changes the weight: it is then a tensor."""
    return isinstance(weight, Tensor)

"""What a step of an environment gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor


@dataclass(frozen=True, slots=True)
class Episodes:
    """Episodes that just ended, one a row."""

    ids: Tensor
    """Environments. (n,) int64"""
    returns: Tensor
    """Undiscounted sums of rewards. (n,)"""
    lengths: Tensor
    """Environment steps. (n,) int64"""
    reward_terms: dict[str, Tensor]
    """Term -> its share of the return, weight included. (n,) each"""
    causes: dict[str, Tensor]
    """Termination -> whether it fired at the end. (n,) bool each"""
    truncated: Tensor
    """Ended by time alone. (n,) bool"""
    success: Tensor | None
    """Met the task's success condition; None where the task has none. (n,) bool"""
    metrics: dict[str, Tensor] = field(default_factory=dict)
    """`command/metric` -> its mean over the episode. (n,) each"""
    mask: Tensor | None = None
    """A GPU gives a row for every environment, valid until the next step, and which of them count. (num_envs,) bool;
    None: all rows do."""

    def ended(self) -> Episodes:
        """Only the rows that count; waits for the device."""
        if self.mask is None:
            return self
        rows = self.mask
        return Episodes(
            self.ids[rows],
            self.returns[rows],
            self.lengths[rows],
            {name: values[rows] for name, values in self.reward_terms.items()},
            {name: values[rows] for name, values in self.causes.items()},
            self.truncated[rows],
            None if self.success is None else self.success[rows],
            {name: values[rows] for name, values in self.metrics.items()},
        )


@dataclass(frozen=True, slots=True)
class StepResult:
    """What one step gave. Tensors are not written to again before the step after the next one."""

    obs: dict[str, Tensor]
    """Group -> observations, of the new episode where one has just begun. (num_envs, d) float32"""
    reward: Tensor
    """(num_envs,) float32"""
    terminated: Tensor
    """The task ended the episode: its last state has no future. (num_envs,) bool"""
    truncated: Tensor
    """Time ran out: bootstrap from `final_obs`, unless it was terminated as well. (num_envs,) bool"""
    final_obs: dict[str, Tensor] | None
    """True last observations, full size; rows are valid where an episode ended (with `final_obs_of = "truncated"`:
    where it ended by time). None if there is known to be no such row. Valid until the next step."""
    episodes: Episodes | None
    """The episodes that ended; None if it is known that none did."""


@dataclass(frozen=True, slots=True)
class StepRecord:
    """One step as observers get it. Tensors belong to the environment: copy what is kept."""

    obs: Mapping[str, Tensor]
    """Group -> observations that the action was taken for. (num_envs, d) float32"""
    action: Tensor
    """(num_envs, a) float32"""
    reward: Tensor
    """(num_envs,) float32"""
    reward_terms: Tensor
    """What each term of `reward_names` paid. (terms, num_envs) float32"""
    episodes: Episodes | None
    """The episodes that end; None if none does."""

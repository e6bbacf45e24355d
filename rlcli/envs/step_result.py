"""Data classes for the results of an environment step: observations, rewards, ended episodes.

`StepResult` is for trainers, `StepRecord` for observers; `Episodes` has the episodes that ended in the step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from torch import Tensor


@dataclass(frozen=True, slots=True)
class Episodes:
    """Episodes that ended in a step, one in each row."""

    ids: Tensor
    """Indices of the environments. (n,) int64"""
    returns: Tensor
    """Undiscounted sums of the rewards. (n,)"""
    lengths: Tensor
    """Lengths in environment steps. (n,) int64"""
    reward_terms: dict[str, Tensor]
    """Reward term -> its weighted sum over the episode. (n,) each"""
    causes: dict[str, Tensor]
    """Termination -> whether it fired at the end. (n,) bool each"""
    truncated: Tensor
    """Whether the episode ended by time-out alone. (n,) bool"""
    success: Tensor | None
    """Whether the episode met the task's conditions of success; None for a task without conditions. (n,) bool"""
    conditions: dict[str, Tensor] = field(default_factory=dict)
    """Condition of success -> whether it held during the last `hold_s` seconds. (n,) bool each"""
    condition_values: dict[str, Tensor] = field(default_factory=dict)
    """Condition of success with a bound -> its value in the last step. (n,) each"""
    metrics: dict[str, Tensor] = field(default_factory=dict)
    """`command/metric` -> mean over the episode; for a direct task: metric -> value in the last step. (n,) each"""
    mask: Tensor | None = None
    """Which rows are valid, on a GPU, where the tensors have a row for every environment; None: all. (num_envs,) bool

    The next step overwrites these tensors; the tensors of `StepResult` stay valid for one step more.
    """

    def ended(self) -> Episodes:
        """Return only the valid rows; on a GPU this forces a host sync."""
        if self.mask is None:
            return self

        def rows(values: Any) -> Any:
            if isinstance(values, dict):
                return {name: rows(value) for name, value in values.items()}
            return None if values is None else values[self.mask]

        return Episodes(**{part.name: rows(getattr(self, part.name)) for part in fields(self) if part.name != "mask"})


@dataclass(frozen=True, slots=True)
class StepResult:
    """Result of one step.

    Its tensors stay valid during the next step and are overwritten by the one after it. `final_obs` and `episodes` are
    exceptions: the next step overwrites their tensors.
    """

    obs: dict[str, Tensor]
    """Group -> observations after resets. (num_envs, d) float32

    Where an episode ended, the row has the first observation of the next episode.
    """
    reward: Tensor
    """Reward of the step. (num_envs,) float32"""
    terminated: Tensor
    """Where the task ended the episode: do not bootstrap, the value after the last state is 0. (num_envs,) bool"""
    truncated: Tensor
    """Where the episode timed out: bootstrap from `final_obs`, unless it was terminated as well. (num_envs,) bool"""
    final_obs: dict[str, Tensor] | None
    """Last observations of the episodes that ended, as group -> (num_envs, d); None if no row is valid.

    A row is valid where an episode ended (with `final_obs_of = "truncated"`: where it timed out).
    """
    episodes: Episodes | None
    """Episodes that ended in this step; None: no episode ended. On a GPU always present: read its `mask`."""


@dataclass(frozen=True, slots=True)
class StepRecord:
    """Data of one step for observers. The tensors belong to the environment: copy those that you keep."""

    obs: Mapping[str, Tensor]
    """Group -> observations from which the action was computed. (num_envs, d) float32"""
    action: Tensor
    """Action of the policy. (num_envs, a) float32"""
    reward: Tensor
    """Reward of the step. (num_envs,) float32"""
    reward_terms: Tensor
    """Weighted value of each term of `reward_names`. (terms, num_envs) float32"""
    episodes: Episodes | None
    """Episodes that end in this step; None if no episode ends."""

"""Counters of the environment loop: steps, episodes, and steps in which the conditions of success hold.

`VecEnv` updates the counters in every step; checkpoints contain the counters.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rlcli.config.schema import SuccessConfig, bound_text
from rlcli.envs.shard_range import Shard
from rlcli.managers.term_binding import BoundTerm, CheckedTerm, first_value
from rlcli.sim.engine import Engine
from rlcli.sim.env_selection import Field, Selection, in_place
from rlcli.sim.saved_tensors import TensorState

_MIN_STATES = 5
"""`reward_gap` needs at least this number of environments with success, and as many without success."""


class SuccessCondition:
    """Condition of the task's section `success`: its last value, and the number of steps for which it has held."""

    def __init__(self, term: BoundTerm, lengths: Tensor, as_field: Callable[[Tensor], Field], step_dt: float) -> None:
        config, first = term.config, first_value(term)
        assert isinstance(config, SuccessConfig)
        self._read = CheckedTerm(term, first, tuple(lengths.shape))
        self.name, self.term, self._as_field = term.name, term, as_field
        self._low, self._high = config.at_least, config.at_most
        self.bounded = (self._low, self._high) != (None, None)
        if self.bounded == (first.dtype == torch.bool):
            if self.bounded:
                raise term.error(f"'{config.func}' returns a boolean; remove at_most and at_least")
            raise term.error(f"'{config.func}' returns a number; add at_most or at_least")
        self.hold_steps = max(1, math.ceil(config.hold_s / step_dt - 1e-6))  # the slack absorbs rounding
        self.steps = torch.zeros_like(lengths, dtype=torch.float32)
        """Number of consecutive steps in which the condition holds. (num_envs,)"""
        self.field = as_field(self.steps)
        self.value: Field = self.field

    def holds(self) -> Field:
        """Return where the condition holds in the current state, and store its value. (num_envs,) bool"""
        self.value = self._as_field(self._read())
        return self._within(self.value)

    def holds_for_tensors(self) -> Tensor:
        """Return where the condition holds in the current state, without storing its value. (num_envs,) bool"""
        held: Tensor = self._within(self._read())
        return held

    def _within(self, value: Any) -> Any:
        if self._low is None:
            return value if self._high is None else value <= self._high
        return value >= self._low if self._high is None else (value >= self._low) & (value <= self._high)

    def describe(self, env_id: int, step_dt: float) -> str:
        """Return the condition in one environment as text, such as `speed 0.21, at most 0.3: has held for 0.4 s`."""
        bound = f" {float(self.value[env_id]):.3g}, {bound_text(self.term.config.model_dump())}" if self.bounded else ""
        held = float(self.steps[env_id]) * step_dt
        return f"{self.name}{bound}: " + (f"has held for {held:.1f} s" if held else "fails")

    def count(self) -> None:
        """Update the number of consecutive steps in which the condition holds: add 1, or set it to 0."""
        self.field += 1.0
        self.field *= self.holds()


class EpisodeCounters(TensorState):
    """Counters of steps and episodes of a shard's environments.

    The attributes `*_field` are views of the tensors, for fast writes.
    """

    def __init__(self, shard: Shard, device: torch.device) -> None:
        num_envs = shard.count
        self.ids = torch.arange(shard.first, shard.first + num_envs, device=device)
        """Indices of these environments in the environments of all processes. (num_envs,) int64"""
        memory = shard.counters
        if memory is None:
            memory = torch.empty(2, num_envs, dtype=torch.int64, device=device)
        self.lengths: Tensor = memory[0].zero_()
        # -1: the first reset of a new environment begins episode 0, like a reset with a seed
        self.indices: Tensor = memory[1].fill_(-1)
        self.common_step = torch.zeros((), dtype=torch.int64, device=device)
        self.conditions: list[SuccessCondition] = []
        self.rewards = torch.zeros(num_envs, device=device)
        """Rewards of the newest step. (num_envs,)"""

    def attach(self, engine: Engine) -> None:
        """Create the attributes `*_field`: views of the tensors for fast writes, on the CPU numpy arrays."""
        self._as_field = engine.as_field
        self.id_field, self.length_field = engine.as_field(self.ids), engine.as_field(self.lengths)
        self.index_field = engine.as_field(self.indices)
        self._common_step = in_place(self.common_step)

    def set_success(self, terms: list[BoundTerm], step_dt: float) -> None:
        """Create a `SuccessCondition` for each term of the task's section `success`."""
        self.conditions = [SuccessCondition(term, self.lengths, self._as_field, step_dt) for term in terms]

    def tensors(self) -> dict[str, Tensor]:
        """Return the counters that a checkpoint contains, by name."""
        return {
            "episode_length": self.lengths,
            "episode_index": self.indices,
            "common_step": self.common_step,
            **{f"success_hold.{condition.name}": condition.steps for condition in self.conditions},
        }

    def advance(self) -> None:
        """Count a step in every environment."""
        self.length_field += 1
        self._common_step += 1

    def count_success(self, reward: Tensor) -> None:
        """Update each condition's number of consecutive steps in which it holds, after a step.

        `reward`, (num_envs,), is stored for `reward_gap`.
        """
        for condition in self.conditions:
            condition.count()
        self.rewards = reward

    def reward_gap(self) -> tuple[float, float] | None:
        """Return how much the newest rewards depend on success: (difference of means, its standard error).

        The difference is the mean reward of environments where all conditions of success hold, minus the mean reward of
        the other environments. None with fewer than five environments of either kind. Environments at the start of an
        episode do not count.
        """
        if not self.conditions:
            return None
        held = functools.reduce(torch.logical_and, (condition.steps > 0.0 for condition in self.conditions))
        inside, outside = (self.rewards[kind & (self.lengths > 0)].double() for kind in (held, ~held))
        if min(len(inside), len(outside)) < _MIN_STATES:
            return None
        error = math.sqrt(sum(float(part.var()) / len(part) for part in (inside, outside)))
        return float(inside.mean() - outside.mean()), error

    def succeeded(self, ended: Selection, timed_out: Tensor) -> dict[str, Any]:
        """Return the attributes `success`, `conditions` and `condition_values` of `Episodes`, by name.

        Args:
            ended: the environments whose episode ends.
            timed_out: which of these episodes end by time-out alone. (n,) bool
        """
        if not self.conditions:
            return {"success": None}
        held = {each.name: ended.read(each.field >= each.hold_steps) for each in self.conditions}
        values = {each.name: ended.read(each.value) for each in self.conditions if each.bounded}
        success = functools.reduce(torch.logical_and, held.values(), timed_out)
        return {"success": success, "conditions": held, "condition_values": values}

    def end(self, terminated: Tensor, truncated: Tensor) -> tuple[Field, Field]:
        """Increase the episode index where an episode ends.

        Returns:
            Where an episode ends, and where it ends by time-out alone. (num_envs,) bool each
        """
        failed, late = self._as_field(terminated), self._as_field(truncated)
        finished = failed | late
        # must come before the selection is made: its random numbers depend on this counter
        self.index_field += finished
        return finished, late > failed

    def reset(self, selection: Selection) -> None:
        """Set the counters of new episodes to zero."""
        selection.write(self.length_field, 0)
        for condition in self.conditions:
            selection.write(condition.field, 0.0)

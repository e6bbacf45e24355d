"""Counters of the environment loop: steps, episodes, and steps in which the success condition holds."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from rlcli.envs.shard_range import Shard
from rlcli.managers.term import BoundTerm, check_shape, first_value
from rlcli.sim.engine import Engine
from rlcli.sim.saved_tensors import TensorState
from rlcli.sim.selection import Field, Selection, in_place


class EpisodeCounters(TensorState):
    """Counters of all environments, also in the form of fields, which selections read and write fastest."""

    def __init__(self, shard: Shard, device: torch.device) -> None:
        num_envs = shard.count
        self.ids = torch.arange(shard.first, shard.first + num_envs, device=device)
        """Numbers of the environments among those of all shards. (num_envs,) int64"""
        memory = shard.counters
        if memory is None:
            memory = torch.empty(2, num_envs, dtype=torch.int64, device=device)
        self.lengths: Tensor = memory[0].zero_()
        # -1: the first reset of a new environment begins episode 0, like a reset with a seed
        self.indices: Tensor = memory[1].fill_(-1)
        self.success_steps = torch.zeros(num_envs, device=device)
        """Number of consecutive steps in which the success condition holds. (num_envs,)"""
        self.common_step = torch.zeros((), dtype=torch.int64, device=device)
        self.success: Callable[[], Tensor] | None = None
        self._hold_steps = 0

    def attach(self, engine: Engine) -> None:
        """Make the fields, once the engine exists."""
        self._as_field = engine.as_field
        self.id_field, self.length_field = engine.as_field(self.ids), engine.as_field(self.lengths)
        self.index_field, self._success_field = engine.as_field(self.indices), engine.as_field(self.success_steps)
        self._common_step = in_place(self.common_step)

    def set_success(self, term: BoundTerm, hold_s: float, step_dt: float) -> None:
        """Set the success condition; it must hold for the last `hold_s` seconds of an episode."""
        check_shape(term, first_value(term), tuple(self.ids.shape))
        self.success = term.call
        self._hold_steps = math.ceil(hold_s / step_dt - 1e-6)

    def tensors(self) -> dict[str, Tensor]:
        """Return the counters that are saved in a checkpoint."""
        return {
            "episode_length": self.lengths,
            "episode_index": self.indices,
            "common_step": self.common_step,
            "success_hold": self.success_steps,
        }

    def advance(self) -> None:
        """Count a step."""
        self.length_field += 1
        self._common_step += 1

    def count_success(self) -> None:
        """Count a step where the success condition holds, and restart the count where it does not."""
        if self.success is not None:
            self._success_field += 1.0
            self._success_field *= self._as_field(self.success())

    def succeeded(self, ended: Selection, timed_out: Tensor) -> Tensor | None:
        """Return which of the ended episodes succeed; None without a condition. timed_out (n,) -> (n,) bool"""
        if self.success is None:
            return None
        return timed_out & (ended.read_view(self._success_field) >= self._hold_steps)

    def end(self, terminated: Tensor, truncated: Tensor) -> tuple[Field, Field]:
        """Count the episodes that end. Return where an episode ends, and where it ends by time-out alone."""
        failed, late = self._as_field(terminated), self._as_field(truncated)
        finished = failed | late
        self.index_field += finished  # before the selection, whose random numbers depend on this counter
        return finished, late > failed

    def reset(self, selection: Selection) -> None:
        """Set the counters of new episodes to zero."""
        selection.write(self.length_field, 0)
        if self.success is not None:
            selection.write(self._success_field, 0.0)

"""What the environment loop counts: steps, episodes, and steps in which the success condition holds."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from rlcli.managers.term import BoundTerm, check_shape, first_value
from rlcli.sim.engine import Engine
from rlcli.sim.selection import Field, Selection, in_place
from rlcli.sim.tensor_state import TensorState


class EpisodeCounters(TensorState):
    """Counters of all environments, each also as a field: the form that the engine's selections use at least cost."""

    def __init__(self, num_envs: int, device: torch.device) -> None:
        self.ids = torch.arange(num_envs, device=device)
        self.lengths = torch.zeros(num_envs, dtype=torch.int64, device=device)
        # the first reset of a new environment begins episode 0, as a reset with a seed does
        self.indices = torch.full((num_envs,), -1, dtype=torch.int64, device=device)
        self.success_steps = torch.zeros(num_envs, device=device)
        """Steps in a row in which the success condition holds. (num_envs,)"""
        self.common_step = torch.zeros((), dtype=torch.int64, device=device)
        self.success: Callable[[], Tensor] | None = None
        self._hold_steps = 0

    def attach(self, engine: Engine) -> None:
        """Make the fields, once there is an engine."""
        self._as_field = engine.as_field
        self.id_field, self.length_field = engine.as_field(self.ids), engine.as_field(self.lengths)
        self.index_field, self._success_field = engine.as_field(self.indices), engine.as_field(self.success_steps)
        self._common_step = in_place(self.common_step)

    def set_success(self, term: BoundTerm, hold_s: float, step_dt: float) -> None:
        """Count the steps of a success condition, which must hold for the last `hold_s` seconds of an episode."""
        check_shape(term, first_value(term), tuple(self.ids.shape))
        self.success = term.call
        self._hold_steps = math.ceil(hold_s / step_dt - 1e-6)

    def tensors(self) -> dict[str, Tensor]:
        """Return what goes into a checkpoint."""
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
        """Count a step towards success where the condition holds; start over where it does not."""
        if self.success is not None:
            self._success_field += 1.0
            self._success_field *= self._as_field(self.success())

    def succeeded(self, ended: Selection, timed_out: Tensor) -> Tensor | None:
        """Return which of the episodes that end succeed; None without a condition. timed_out (n,) -> (n,) bool"""
        if self.success is None:
            return None
        return timed_out & (ended.read_view(self._success_field) >= self._hold_steps)

    def end(self, terminated: Tensor, truncated: Tensor) -> tuple[Field, Field]:
        """Count the episodes that end, and return where one does and where one does by time alone."""
        failed, late = self._as_field(terminated), self._as_field(truncated)
        finished = failed | late
        self.index_field += finished  # before the selection: the next episode draws from its own counter
        return finished, late > failed

    def reset(self, selection: Selection) -> None:
        """Start to count new episodes."""
        selection.write(self.length_field, 0)
        if self.success is not None:
            selection.write(self._success_field, 0.0)

"""Manager of the curriculum terms, which change settings during training, by training step or by ended episodes."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from rlcli.managers.term_binding import BoundTerm, EnvContext
from rlcli.sim.env_selection import Selection
from rlcli.sim.saved_tensors import TensorState, mean_of


class CurriculumManager(TensorState):
    """Manager of the curriculum terms.

    A term is a function `name(env, selection, *, ...)` or a class. The manager calls a term with the environments whose
    episode ends, before these environments are reset. A class may have a method `advance(step)` instead, which is
    called once in each step with the number of steps so far, so that a schedule does not depend on resets. A call or
    `advance` may return a value to log, a number or a tensor (num_envs,); the mean of the tensor is logged.
    """

    def __init__(self, terms: list[BoundTerm], context: EnvContext) -> None:
        self.terms = terms
        self._tunable = context.tunable
        self._scheduled = [term for term in terms if hasattr(term.instance, "advance")]
        self._per_episode = [term for term in terms if not hasattr(term.instance, "advance")]
        self._values = {term.name: torch.full((context.num_envs,), torch.nan, device=context.device) for term in terms}

    def advance(self, step: Tensor) -> None:
        """Call the scheduled terms (those with `advance`) with the training step. step () int64"""
        for term in self._scheduled:
            self._store(term, term.instance.advance(step))

    def compute(self, ended: Selection) -> None:
        """Call the terms that use ended episodes, with the environments whose episode ends."""
        for term in self._per_episode:
            self._store(term, term.call(ended.stream(term.stream)))

    def values(self) -> dict[str, Tensor]:
        """Return the last value that each term returned, by the name of its metric. (num_envs,) each"""
        return {f"Curriculum/{name}": value for name, value in self._values.items()}

    def tensors(self) -> dict[str, Tensor]:
        """Return the current values of the settings that the curriculum changes, by name, to save them."""
        return {f"live.{path}": value for path, value in self._tunable.tensors().items()}

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the settings that the curriculum changes, and the means of the logged values."""
        return {**super().state_dict(), **{f"value.{name}": mean_of(value) for name, value in self._values.items()}}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the state returned by `state_dict()`."""
        super().load_state_dict(state)
        for name, value in self._values.items():
            value.copy_(state[f"value.{name}"])

    def _store(self, term: BoundTerm, value: Tensor | float | None) -> None:
        if isinstance(value, Tensor):
            own = self._values[term.name]
            own.copy_(value if value.shape in (own.shape, ()) else value.float().mean())
        elif value is not None:
            self._values[term.name].fill_(value)

"""Events: what happens to some environments at the start, at each reset, or at intervals."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import Tensor

from rlcli.managers.term import BoundTerm
from rlcli.sim.selection import Selection

Select = Callable[[Tensor], Selection | None]


class EventManager:
    """Interval timers run an environment each; they start anew with its episode."""

    def __init__(self, terms: list[BoundTerm], num_envs: int, step_dt: float, device: torch.device) -> None:
        by_mode: dict[str, list[BoundTerm]] = {"startup": [], "reset": [], "interval": []}
        for term in terms:
            by_mode[term.config.mode].append(term)  # type: ignore[attr-defined]
        self._startup, self._reset, self._interval = by_mode["startup"], by_mode["reset"], by_mode["interval"]
        self._step_dt = step_dt
        self._time_left = torch.zeros(len(self._interval), num_envs, device=device)

    def startup(self, everyone: Selection) -> None:
        """Fire the startup events, once."""
        for term in self._startup:
            term.call(everyone.stream(term.stream))

    def reset(self, selection: Selection) -> None:
        """Fire the reset events of new episodes, and start their interval timers."""
        for term in self._reset:
            term.call(selection.stream(term.stream))
        for term, left in zip(self._interval, self._time_left, strict=True):
            selection.write(left, self._draw(term, selection))

    @property
    def has_intervals(self) -> bool:
        """Whether any event fires at intervals."""
        return bool(self._interval)

    def interval(self, select: Select) -> None:
        """Let one step pass and fire what is due; `select` draws from the step's own counter."""
        for term, left in zip(self._interval, self._time_left, strict=True):
            left -= self._step_dt
            due = select(left < 1e-6)
            if due is not None:
                term.call(due.stream(term.stream))
                due.write(left, self._draw(term, due))

    def state_dict(self) -> dict[str, Tensor]:
        """The interval timers."""
        return {"time_left": self._time_left.clone()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Take back what `state_dict` gave."""
        self._time_left.copy_(state["time_left"])

    def _draw(self, term: BoundTerm, selection: Selection) -> Tensor:
        low, high = term.config.interval_range_s  # type: ignore[attr-defined]
        return selection.stream(term.stream ^ _TIMER).uniform(low, high)


_TIMER = np.uint64(0x54494D4552)

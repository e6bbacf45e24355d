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
        self.terms = terms
        by_mode: dict[str, list[BoundTerm]] = {"startup": [], "reset": [], "interval": []}
        for term in terms:
            by_mode[term.config.mode].append(term)  # type: ignore[attr-defined]
        self._startup, self._reset, self._interval = by_mode["startup"], by_mode["reset"], by_mode["interval"]
        self._step_dt = step_dt
        # counted in whole steps: subtracting step_dt again and again drifts
        self._steps_left = torch.zeros(len(self._interval), num_envs, dtype=torch.int64, device=device)

    @property
    def has_intervals(self) -> bool:
        """Whether there are interval events at all."""
        return bool(self._interval)

    def startup(self, everyone: Selection) -> None:
        """Fire the startup events, once."""
        for term in self._startup:
            term.call(everyone.stream(term.stream))

    def reset(self, selection: Selection) -> None:
        """Fire the reset events of new episodes, and start their interval timers."""
        for term in self._reset:
            term.call(selection.stream(term.stream))
        for term, left in zip(self._interval, self._steps_left, strict=True):
            selection.write(left, self._draw(term, selection, _FIRST))

    def interval(self, select: Select, running: Tensor, fired: Callable[[Selection], None]) -> None:
        """Let one step pass where an episode is `running` (1 or 0) and fire what is due, telling `fired` after each.

        `select` draws from the step's own counter.
        """
        for term, left in zip(self._interval, self._steps_left, strict=True):
            left -= running
            due = select(left <= 0)
            if due is not None:
                term.call(due.stream(term.stream))
                due.write(left, self._draw(term, due, _NEXT))
                fired(due)

    def state_dict(self) -> dict[str, Tensor]:
        """The interval timers."""
        return {"steps_left": self._steps_left.clone()}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Take back what `state_dict` gave."""
        self._steps_left.copy_(state["steps_left"])

    def _draw(self, term: BoundTerm, selection: Selection, timer: np.uint64) -> Tensor:
        low, high = term.config.interval_range_s  # type: ignore[attr-defined]
        steps = selection.stream(term.stream ^ timer).uniform(low, high).double() / self._step_dt
        return (steps * (1.0 - 1e-6)).ceil_().long()  # the slack absorbs rounding: 0.1 s at 0.02 s are 5 steps


# Two streams: an episode's first interval is drawn by the episode's number, the later ones by the step's.
_FIRST, _NEXT = np.uint64(0x5449_4D45_5231), np.uint64(0x5449_4D45_5232)

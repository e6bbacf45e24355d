"""Manager of the event terms, which change some environments at startup, at each reset, or at intervals."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from rlcli.managers.term_binding import BoundTerm, EnvContext, resets
from rlcli.sim.env_selection import Selection
from rlcli.sim.saved_tensors import TensorState

Select = Callable[[Tensor], Selection | None]
"""Function from a mask (num_envs,) to a `Selection` of the environments where it is true; None if there are none."""
Callback = Callable[[Selection], None]


class EventManager(TensorState):
    """Manager of the event terms. Each environment has its own interval timers, except those with `global_time: true`.

    After events that change masses, inertias and similar fields of the model, the engine recomputes the constants that
    MuJoCo derives from these fields.
    """

    def __init__(self, terms: list[BoundTerm], context: EnvContext) -> None:
        num_envs, device = context.num_envs, context.device
        by_mode: dict[str, list[BoundTerm]] = {"startup": [], "reset": [], "interval": []}
        for term in terms:
            by_mode[term.config.mode].append(term)  # type: ignore[attr-defined]
        self.terms = terms
        self._startup, self._reset, self._interval = by_mode["startup"], by_mode["reset"], by_mode["interval"]
        self._updating = [term.instance for term in terms if hasattr(term.instance, "update")]
        self._step_dt = context.step_dt
        self._set_constants = context.engine.set_constants
        # whole steps: repeated subtraction of step_dt would accumulate rounding errors
        self._steps_left = torch.zeros(len(self._interval), num_envs, dtype=torch.int64, device=device)
        self._fired_at = torch.full((len(self._reset), num_envs), _NEVER, dtype=torch.int64, device=device)
        self._resets = list(zip(self._reset, self._fired_at.unbind(0), strict=True))
        self._intervals = list(zip(self._interval, self._steps_left.unbind(0), strict=True))
        self._resets_derive = any(map(_derives, self._reset))
        self._term_resets = resets(terms)
        self.leader = next((term.name for term in self._reset if getattr(term.instance, "fires_resets", False)), None)
        """Name of the only reset event that `reset` fires: it calls `fire_resets` for the others. None: all fire."""

    @property
    def derives(self) -> bool:
        """Whether an event changes model fields, such as masses, from which MuJoCo derives constants."""
        return any(map(_derives, self.terms))

    @property
    def has_intervals(self) -> bool:
        """Whether any event acts between resets."""
        return bool(self._interval or self._updating)

    def startup(self, all_envs: Selection) -> None:
        """Fire the startup events, once."""
        for term in self._startup:
            term.call(all_envs.stream(term.stream))
        self._derive_constants(self._startup, all_envs)

    def before_full_reset(self, all_envs: Selection) -> None:
        """Prepare for a reset of all environments: forget when reset events fired, and draw the `global_time` timers.

        `all_envs` selects all environments; its random numbers depend on the current step.
        """
        self._fired_at.fill_(_NEVER)
        for term, left in self._intervals:
            if _is_global(term):
                all_envs.write(left, self._draw(term, all_envs, _FIRST))

    def reset(self, selection: Selection, step: Tensor) -> None:
        """Fire the reset events of new episodes, and start their interval timers; `step` is the training step."""
        for reset in self._term_resets:
            reset(selection)
        if self.leader is None:
            self.fire_resets(selection, step)
        for term, _ in self._resets:
            if term.name == self.leader:
                term.call(selection.stream(term.stream))
        if self._resets_derive:
            self._set_constants(selection)
        for term, left in self._intervals:
            if not _is_global(term):
                selection.write(left, self._draw(term, selection, _FIRST))

    def fire_resets(self, selection: Selection, step: Tensor) -> None:
        """Fire the reset events except the `leader`, in the order of the configuration; `step` is the training step."""
        for term, fired_at in self._resets:
            if term.name == self.leader:
                continue
            min_steps = term.config.min_steps_between  # type: ignore[attr-defined]
            due = selection.where(step - fired_at >= min_steps) if min_steps else selection
            if due is not None:
                term.call(due.stream(term.stream))
                if min_steps:
                    due.write(fired_at, step.expand(1))

    def interval(self, select: Select, running: Tensor, fired: Callback) -> None:
        """Count a step of the interval timers, and fire the events that are due.

        Args:
            select: function from a mask to a selection, whose random numbers depend on the current step.
            running: 0 where an episode has just begun, so that its timers do not count yet (except those with
                `global_time`), else 1. (num_envs,)
            fired: called after each event, with the environments that the event changed.
        """
        for instance in self._updating:
            instance.update(select, running)
        for term, left in self._intervals:
            left -= 1 if _is_global(term) else running
            due = select(left <= 0)
            if due is not None:
                term.call(due.stream(term.stream))
                self._derive_constants([term], due)
                due.write(left, self._draw(term, due, _NEXT))
                fired(due)

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors to save: interval timers, and training steps at which reset events fired last."""
        return {"steps_left": self._steps_left, "fired_at": self._fired_at}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the state returned by `state_dict()`. Checkpoints of earlier versions of rlcli have no `fired_at`."""
        super().load_state_dict({"fired_at": self._fired_at, **state})

    def _derive_constants(self, fired: Sequence[BoundTerm], selection: Selection) -> None:
        if any(map(_derives, fired)):
            self._set_constants(selection)

    def _draw(self, term: BoundTerm, selection: Selection, timer: np.uint64) -> Tensor:
        low, high = term.config.interval_range_s  # type: ignore[attr-defined]
        stream = selection.stream(term.stream ^ timer)
        drawn = stream.uniform_of_first(low, high) if _is_global(term) else stream.uniform(low, high)
        steps = drawn.double() / self._step_dt
        # the slack absorbs rounding: 0.1 s at 0.02 s are 5 steps
        return (steps * (1.0 - 1e-6)).ceil_().clamp_(min=1).long()


def _derives(term: BoundTerm) -> bool:
    """Return whether an event changes model fields from which the engine derives constants."""
    return bool(getattr(term.instance, "derives", False))


def _is_global(term: BoundTerm) -> bool:
    return bool(term.config.global_time)  # type: ignore[attr-defined]


_NEVER = -(1 << 62)
"""Value of `fired_at` where a reset event has not fired yet."""
# Two random streams: the first interval of an episode depends on the episode's index, later ones on the step's.
_FIRST, _NEXT = np.uint64(0x5449_4D45_5231), np.uint64(0x5449_4D45_5232)

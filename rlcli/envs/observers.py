"""Base class and registry of observers, which the environment loop calls at fixed points of each step.

Recorders, crash dumps and statistics of evaluations are observers. Most observers only read.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:  # the start of a training imports this module before torch
    from rlcli.envs.step_result import StepRecord
    from rlcli.sim.divergence_report import Divergence


class StepObserver:
    """Base class of observers of environment steps; override the methods that you need.

    Add an observer with `env.observers.add(observer)`. A method that no observer overrides costs nothing in a step.
    """

    __slots__ = ()

    def before_step(self) -> None:
        """Run at the start of a step, before any change; an exception prevents the step."""

    def after_physics(self) -> None:
        """Run on the state from which rewards and terminations are computed, before any reset."""

    def on_divergence(self, found: list[Divergence], pending: bool) -> None:
        """Run when simulations have diverged, or when an event or a reset wrote values that are out of bounds.

        The method runs before a reset deletes the recorded engine calls.

        Args:
            found: environment and cause of the first few divergences (`rlcli.sim.divergence_report.Divergence`).
            pending: True: an event or a reset wrote bad values, and no physics step has used them; False: physics
                diverged.
        """

    def on_step(self, record: StepRecord) -> None:
        """Run after rewards and terminations are computed, before any reset.

        Args:
            record: observations, actions, rewards and ended episodes of the step (`rlcli.envs.step_result.StepRecord`).
        """


_Observer = TypeVar("_Observer", bound=StepObserver)


class Observers:
    """Observers of one environment; a step calls only the methods that they override, in the order of `add`."""

    def __init__(self) -> None:
        self._set(())

    def add(self, observer: StepObserver) -> None:
        """Add an observer; the following steps call its methods after those of earlier observers."""
        self._set((*self._observers, observer))

    def remove(self, observer: StepObserver) -> None:
        """Remove an observer if it is present. An observer may remove itself in one of its methods."""
        self._set(tuple(other for other in self._observers if other is not observer))

    @contextmanager
    def added(self, observer: _Observer) -> Iterator[_Observer]:
        """Add an observer for the duration of a `with` block."""
        self.add(observer)
        try:
            yield observer
        finally:
            self.remove(observer)

    def run_on_step(self, record: StepRecord) -> None:
        """Call `on_step` of the observers that override it."""
        for on_step in self.on_step:
            on_step(record)

    def run_on_divergence(self, found: list[Divergence], *, pending: bool) -> None:
        """Call `on_divergence` of the observers that override it."""
        for on_divergence in self.on_divergence:
            on_divergence(found, pending)

    def _set(self, observers: tuple[StepObserver, ...]) -> None:
        # new tuples, so that a loop over the old ones is not disturbed
        self._observers = observers
        self.before_step = tuple(o.before_step for o in observers if _overrides(o, "before_step"))
        self.after_physics = tuple(o.after_physics for o in observers if _overrides(o, "after_physics"))
        self.on_divergence = tuple(o.on_divergence for o in observers if _overrides(o, "on_divergence"))
        self.on_step = tuple(o.on_step for o in observers if _overrides(o, "on_step"))


def _overrides(observer: StepObserver, method: str) -> bool:
    return getattr(type(observer), method) is not getattr(StepObserver, method)

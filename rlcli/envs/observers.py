"""Observers of the environment loop: they watch a step and change nothing in it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rlcli.envs.step import StepRecord
    from rlcli.sim.divergence_report import Divergence


class StepObserver:
    """Base class of an observer of environment steps; override the methods that are needed.

    Add it with `env.observers.add(observer)`. A method that no observer overrides costs nothing in a step.
    """

    __slots__ = ()

    def before_step(self) -> None:
        """Run before the step does anything; raise to prevent the step."""

    def after_physics(self) -> None:
        """Run on the state that rewards and terminations are computed from, before any reset."""

    def on_divergence(self, found: list[Divergence], pending: bool) -> None:
        """Run when simulations have diverged, while `engine.trace` still shows their last calls.

        Args:
            found: the first of the divergences.
            pending: whether the next engine call is the one that fails: an event or a reset wrote the state.
        """

    def on_step(self, record: StepRecord) -> None:
        """Run after rewards and terminations are computed, before any reset."""


class Observers:
    """The observers of one environment, with the methods that they override in the order of `add`."""

    def __init__(self) -> None:
        self._set(())

    def add(self, observer: StepObserver) -> None:
        """Add an observer."""
        self._set((*self._observers, observer))

    def remove(self, observer: StepObserver) -> None:
        """Remove an observer, if it is there; it may remove itself while it is called."""
        self._set(tuple(other for other in self._observers if other is not observer))

    @contextmanager
    def added(self, observer: StepObserver) -> Iterator[None]:
        """Add an observer for the length of a `with` block."""
        self.add(observer)
        try:
            yield
        finally:
            self.remove(observer)

    def run_on_step(self, record: StepRecord) -> None:
        """Call `on_step` of the observers that have it."""
        for on_step in self.on_step:
            on_step(record)

    def run_on_divergence(self, found: list[Divergence], *, pending: bool) -> None:
        """Call `on_divergence` of the observers that have it."""
        for on_divergence in self.on_divergence:
            on_divergence(found, pending)

    def _set(self, observers: tuple[StepObserver, ...]) -> None:
        # new tuples: a loop over the old ones goes on undisturbed
        self._observers = observers
        self.before_step = tuple(o.before_step for o in observers if _overrides(o, "before_step"))
        self.after_physics = tuple(o.after_physics for o in observers if _overrides(o, "after_physics"))
        self.on_divergence = tuple(o.on_divergence for o in observers if _overrides(o, "on_divergence"))
        self.on_step = tuple(o.on_step for o in observers if _overrides(o, "on_step"))


def _overrides(observer: StepObserver, method: str) -> bool:
    return getattr(type(observer), method) is not getattr(StepObserver, method)

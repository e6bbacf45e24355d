"""Execution of a task's own code before each physics step, such as the method `apply_actions` of an action.

An environment step has several physics steps.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.sim.env_selection import Selection

_STALE = "_isaaclab_stale_state"


class StepCode(Protocol):
    """Interface of an object whose code runs before each physics step, and whose tensors are saved in checkpoints."""

    def apply(self) -> None:
        """Write targets and forces for the next physics step."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the object's tensors, by name, for a checkpoint."""

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the tensors returned by `state_dict`."""


class Substeps:
    """Adapter that calls a task's code before each physics step of an environment.

    rlcli caches values such as poses of bodies once per environment step. If the code reads such a value after the
    first physics step of an environment step, the cached values are updated first, once per physics step.

    Args:
        managed: the environment.
        name: name of this object among the actuator models of the environment.
        code: the task's code.
    """

    def __init__(self, managed: VecEnv, name: str, code: StepCode) -> None:
        self._managed, self._code = managed, code
        self._is_first = True
        actuators: dict[str, Any] = managed.actuators
        models = dict(actuators)
        actuators.clear()
        actuators[name] = self  # before the actuator models, which read the targets
        actuators.update(models)

    def start(self) -> None:
        """Mark the start of an environment step, in which the cached values are up to date."""
        self._is_first = True

    def compute(self) -> None:
        """Run the task's code; the environment calls this before each physics step."""
        if not self._is_first:
            vars(self._managed)[_STALE] = lambda: self._managed.sim.on_moved(self._managed._select_all())
        self._is_first = False
        self._code.apply()
        vars(self._managed).pop(_STALE, None)

    def reset(self, selection: Selection) -> None:
        """Do nothing: the task's code is reset by the term that it belongs to."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the code's tensors."""
        return self._code.state_dict()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the tensors returned by `state_dict`."""
        self._code.load_state_dict(state)


def update_state(managed: VecEnv) -> None:
    """Update the values that an environment caches, if a physics step has run since they were computed."""
    update: Callable[[], None] | None = vars(managed).pop(_STALE, None)
    if update is not None:
        update()

"""Code of a task that runs before each physics step, with the state of that physics step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from torch import Tensor

from rlcli.envs.vec_env import VecEnv
from rlcli.sim.env_selection import Selection

_STALE = "_isaaclab_stale_state"


class StepCode(Protocol):
    """Code that runs before each physics step, and its state."""

    def apply(self) -> None:
        """Write targets and forces for the next physics step."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the tensors that a checkpoint contains."""

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the tensors returned by `state_dict`."""


class Substeps:
    """Caller of a task's code before each physics step of an environment.

    Between the physics steps of one environment step rlcli does not update the values that it caches. If the code reads
    a state there, the state is updated first, once per physics step.
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
        """Begin an environment step."""
        self._is_first = True

    def compute(self) -> None:
        """Run the code before a physics step."""
        if not self._is_first:
            vars(self._managed)[_STALE] = lambda: self._managed.sim.on_moved(self._managed._select_all())
        self._is_first = False
        self._code.apply()
        vars(self._managed).pop(_STALE, None)

    def reset(self, selection: Selection) -> None:
        """Do nothing: the code resets itself."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return copies of the code's tensors."""
        return self._code.state_dict()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the tensors returned by `state_dict`."""
        self._code.load_state_dict(state)


def update_state(managed: VecEnv) -> None:
    """Update the cached state, if a physics step has run since it was computed."""
    update: Callable[[], None] | None = vars(managed).pop(_STALE, None)
    if update is not None:
        update()

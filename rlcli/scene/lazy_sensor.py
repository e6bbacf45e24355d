"""Base class of sensors that are computed when they are read."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

from torch import Tensor

from rlcli.sim.selection import Selection


class LazySensor(ABC):
    """A sensor whose values follow from the state of the bodies, computed at most once a step."""

    def __init__(self) -> None:
        self._current = False
        """Whether the values are those of the present state."""

    def update(self, dt: float) -> None:
        """Drop the values: a step has moved the bodies."""
        self._current = False

    def reset(self, selection: Selection) -> None:
        """Compute anew for the selected environments: a reset has moved their bodies."""
        self.on_moved(selection)

    @abstractmethod
    def on_moved(self, selection: Selection) -> None:
        """Compute anew for the selected environments, if the values have been read in this step."""

    def close(self) -> None:
        """Free what the sensor holds: nothing."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return nothing: the values follow from the state of the bodies."""
        return {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Drop the values: the loaded state has moved the bodies."""
        self._current = False

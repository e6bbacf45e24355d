"""Base class of sensors whose values are computed only when a term reads them.

Ray sensors and cameras derive from it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

from torch import Tensor

from rlcli.sim.env_selection import Selection


class LazySensor(ABC):
    """Sensor whose values follow from the state of the bodies and are computed at most once per step."""

    def __init__(self) -> None:
        self._current = False
        """Whether the values have been computed from the present state."""

    def update(self, dt: float) -> None:
        """Mark the values as outdated: a step of `dt` seconds has moved the bodies."""
        self._current = False

    def reset(self, selection: Selection) -> None:
        """Update the selected environments: a reset has moved their bodies."""
        self.on_moved(selection)

    @abstractmethod
    def on_moved(self, selection: Selection) -> None:
        """Compute again the values of environments whose bodies were moved, if values have been read in this step."""

    def close(self) -> None:
        """Free the resources of the sensor; a sensor without resources does nothing."""

    def state_dict(self) -> dict[str, Tensor]:
        """Return an empty dictionary: the values follow from the state of the bodies."""
        return {}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Mark the values as outdated: the loaded state has moved the bodies."""
        self._current = False

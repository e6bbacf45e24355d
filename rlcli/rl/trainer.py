"""Interface `Trainer` between the training loop and every trainer, built in or from a plugin.

`TrainerState` and `Report` are the data that a trainer returns to the training loop.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from torch import Tensor

    from rlcli.rl.policy import Policy


@dataclass(frozen=True, slots=True)
class Rows:
    """Rows of data that only grows, such as a replay buffer; a checkpoint writes only the rows added since the last."""

    first: int
    """Index of the oldest row that is still needed. Row 0 is the first row ever stored."""
    stop: int
    """Index after the newest row."""
    read: Callable[[int, int], dict[str, Tensor]]
    """read(start, stop) returns copies of the rows, as they were when the state was taken, by column name.
    (stop - start, ...) each"""


@dataclass(slots=True)
class TrainerState:
    """State of a trainer between two iterations, as a checkpoint stores it; training continues from it exactly."""

    tensors: dict[str, dict[str, Tensor]] = field(default_factory=dict)
    """Name of a file of the checkpoint without its suffix, such as `policy` -> name of a tensor -> tensor."""
    values: dict[str, Any] = field(default_factory=dict)
    """State that is not in tensors, such as `iteration` and `env_steps`, as plain JSON."""
    logs: dict[str, Rows] = field(default_factory=dict)
    """Name of data that only grows, such as `replay` (a replay buffer) -> its rows."""


@dataclass(slots=True)
class Report:
    """Metrics and durations of one iteration, which the training loop logs and shows."""

    metrics: dict[str, float]
    """Name of a metric, such as `Loss/value` -> its value in this iteration."""
    seconds: dict[str, float]
    """Part of the iteration, such as physics or update -> duration [s]."""


class Trainer(Protocol):
    """Algorithm that trains a policy in an environment; between two iterations its state can be saved and restored."""

    @property
    def iteration(self) -> int:
        """Number of finished iterations."""

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of an iteration, over all environments and processes."""

    @property
    def env_steps(self) -> int:
        """Environment steps so far, over all environments and processes."""

    def start(self) -> None:
        """Reset the environment. The training loop calls this once, before the first iteration of a new run.

        In a resumed run `load` is called instead.
        """

    def iterate(self) -> Report:
        """Do one iteration: collect experience, then update the networks; return metrics and durations."""

    def policy(self) -> Policy:
        """Return the current policy, with a copy of the weights."""

    def state(self) -> TrainerState:
        """Return a copy of the state for a checkpoint, between two iterations.

        The rows of its `logs` are not copied yet: they can be read until the end of the next iteration.
        """

    def load(self, state: TrainerState) -> None:
        """Restore the state returned by `state()`."""

    def load_weights(self, policy: Mapping[str, Tensor]) -> None:
        """Load the weights and the normaliser of a saved policy, and nothing else (`--init-from`).

        The training loop calls this before `start`.
        """

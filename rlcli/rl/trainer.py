"""The protocol between the training loop and a trainer, and the data that they exchange."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from torch import Tensor

    from rlcli.rl.policy import Policy


@dataclass(frozen=True, slots=True)
class Rows:
    """The newest rows of data that only grows, such as a replay buffer; each row is written to the disk once."""

    first: int
    """The oldest row that is still needed, counted from the first row ever stored."""
    stop: int
    """One after the newest."""
    read: Callable[[int, int], dict[str, Tensor]]
    """read(start, stop) returns copies of rows by column, as they were at the boundary. (stop - start, ...)"""


@dataclass(slots=True)
class TrainerState:
    """State from which training continues exactly: tensors by file, plain JSON, and rows by the name of their log."""

    tensors: dict[str, dict[str, Tensor]] = field(default_factory=dict)
    values: dict[str, Any] = field(default_factory=dict)
    logs: dict[str, Rows] = field(default_factory=dict)


@dataclass(slots=True)
class Report:
    """Results of one iteration: metrics by name, and the seconds it took by part."""

    metrics: dict[str, float]
    seconds: dict[str, float]


class Trainer(Protocol):
    """Learner in a `VecEnv`; between two iterations its state can be saved and restored exactly."""

    @property
    def iteration(self) -> int:
        """Iterations done."""
        ...

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of an iteration, over all environments."""
        ...

    @property
    def env_steps(self) -> int:
        """Environment steps taken, over all environments."""
        ...

    def start(self) -> None:
        """Reset the environment; called once, before the first iteration of a run that is not resumed."""
        ...

    def iterate(self) -> Report:
        """Collect experience and update once."""
        ...

    def policy(self) -> Policy:
        """Return the policy as it is now, with weights of its own."""
        ...

    def state(self) -> TrainerState:
        """Return a copy of the state; the rows of its logs may be read until the end of the next iteration."""
        ...

    def load(self, state: TrainerState) -> None:
        """Restore a state."""
        ...

    def load_weights(self, policy: Mapping[str, Tensor]) -> None:
        """Load only the policy's weights (`--init-from`)."""
        ...

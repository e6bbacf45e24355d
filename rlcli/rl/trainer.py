"""What a trainer does: the protocol that the training loop drives, and what passes between them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from torch import Tensor

    from rlcli.rl.policy import Policy


@dataclass(frozen=True, slots=True)
class Rows:
    """The newest rows of something that only grows, such as a replay buffer: each is written to the disk once."""

    first: int
    """The oldest row that is still needed, counted from the first that there ever was."""
    stop: int
    """One after the newest."""
    read: Callable[[int, int], dict[str, Tensor]]
    """read(start, stop) copies rows of every column, as they were at the boundary. (stop - start, ...)"""


@dataclass(slots=True)
class TrainerState:
    """Everything a trainer needs to go on exactly: tensors by file, plain JSON, and rows by the name of their log."""

    tensors: dict[str, dict[str, Tensor]] = field(default_factory=dict)
    values: dict[str, Any] = field(default_factory=dict)
    logs: dict[str, Rows] = field(default_factory=dict)


@dataclass(slots=True)
class Report:
    """What one iteration did: losses and rates by metric name, and the seconds it took by part."""

    metrics: dict[str, float]
    seconds: dict[str, float]
    notes: list[str] = field(default_factory=list)
    """What the user should know, said once."""


class Trainer(Protocol):
    """Learns in a `VecEnv`, one iteration at a time; between iterations it can be saved and restored exactly."""

    iteration: int
    steps_per_iteration: int

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
        """The policy as it is now, sharing its weights."""
        ...

    def state(self) -> TrainerState:
        """A copy of the state at this boundary; rows of logs may be read until the end of the next iteration."""
        ...

    def load(self, state: TrainerState) -> None:
        """Go back to a boundary."""
        ...

    def load_weights(self, policy: Mapping[str, Tensor]) -> None:
        """Take only the policy's weights (`--init-from`)."""
        ...

"""What viewers and playback share: the table of viewers, the interface of each, and the state that each shows.

A new viewer is a module in this folder with a function of the protocol `Viewer`, and a line in `VIEWERS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rlcli.managers.command import Knob
    from rlcli.rl.acting import Act
    from rlcli.viewer.playback import Playback

VIEWERS = {"native": "rlcli.viewer.native:run", "web": "rlcli.viewer.web:run"}
"""Name of a viewer -> the function that runs it, imported when the viewer opens."""
DEFAULT_PORT = 8080

Ready = Callable[[Sequence[str], str | None], None]
"""Receives lines of instructions for the user, and the viewer's address if it has one."""


class Viewer(Protocol):
    """A function that shows a playback until the user closes the viewer."""

    def __call__(self, playback: Playback, *, title: str, together: int, port: int, ready: Ready) -> None:
        """Show the playback in real time.

        Args:
            playback: environments and policy.
            title: task and run, for the user.
            together: how many environments are drawn.
            port: port on the loopback interface, of a viewer that is a server; 0: a free one.
            ready: called when the viewer is open.

        Raises:
            MachineError: if this machine cannot open the viewer.
            DependencyError: if a package is missing, or of another version.
        """
        ...


class CheckpointSource(Protocol):
    """The checkpoints that may be played."""

    def steps(self) -> list[int]:
        """Return the steps of the checkpoints that exist now, ascending."""
        ...

    def load(self, step: int) -> Act:
        """Return the policy of a checkpoint.

        Raises:
            CheckpointError: if it is not there any more, damaged, or of another task.
        """
        ...


@dataclass(frozen=True, slots=True)
class View:
    """Immutable state of a playback, as a viewer shows it."""

    paused: bool
    speed: float
    shown: int
    num_envs: int
    episode_s: float
    """Time since the shown episode began [s]."""
    reward: float
    """Reward of the last step in the shown environment."""
    episodes: int
    """Episodes of the shown environment that have ended."""
    checkpoint: int | None
    """Step of the policy; None: it is of no checkpoint."""
    checkpoints: tuple[int, ...]
    follow: bool
    knobs: tuple[Knob, ...]
    held: Mapping[str, float]
    knob: int
    """Index of the knob that keys change."""
    message: str

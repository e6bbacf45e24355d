"""Interface between viewers and playback: the table of viewers, the protocol of a viewer, and the state that it shows.

A new viewer is a module in this folder with a function of the protocol `Viewer`, and a line in `VIEWERS`. The section
"A viewer" of CONTRIBUTING.md lists the other places that name the viewers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rlcli.managers.command import Knob
    from rlcli.viewer.playback import Playback
    from rlcli.viewer.playback_statistics import RewardCurves

VIEWERS = {"native": "rlcli.viewer.native:run", "web": "rlcli.viewer.web:run"}
"""Name of a viewer -> import path of the function that runs it."""
DEFAULT_PORT = 8080
"""Port of the web viewer."""
REQUEST_KEYS: dict[str, tuple[int, str | None]] = {
    "pause": (32, "Space"), "step": (262, "RightArrow"), "reset": (259, "Backspace"), "slower": (45, "Minus"),
    "faster": (61, "Equal"), "next environment": (265, "UpArrow"), "previous environment": (264, "DownArrow"),
    "newer checkpoint": (266, "PageUp"), "older checkpoint": (267, "PageDown"), "previous command": (268, None),
    "next command": (269, None), "raise command": (260, None), "lower command": (261, None),
}  # fmt: skip
"""Name of a request (see `Playback.requests`) -> its key: the key's code in GLFW, for the window, and its name in Dear
ImGui, for the browser (None: no key).

A viewer with other key codes has a table of its own in its module.
"""

Ready = Callable[[Sequence[str], str | None], None]
"""Type of the callback `ready`, which takes lines of instructions for the user, and the viewer's URL, or None."""


class Viewer(Protocol):
    """A function that shows a playback until the user closes the viewer."""

    def __call__(self, playback: Playback, *, title: str, num_drawn: int, port: int, ready: Ready) -> None:
        """Show the playback in real time.

        A viewer does not catch `KeyboardInterrupt`, because Ctrl-C ends the command. A viewer writes nothing to stdout,
        which is for results; the caller prints the lines that `ready` receives.

        Args:
            playback: environments and policy.
            title: task and run, for the user.
            num_drawn: number of environments in the image: the shown one and those after it (`EnvGrid.others`).
            port: port on the loopback interface; 0: any free port. Only for a viewer that is a server.
            ready: callback that the viewer calls once, when the viewer is open and before the first image.

        Raises:
            MachineError: if this machine cannot open the viewer.
            DependencyError: if a package is missing, or its version is not supported.
        """


@dataclass(frozen=True, slots=True)
class View:
    """Immutable snapshot of a playback for a viewer."""

    paused: bool
    speed: float
    """Speed as a multiple of real time."""
    shown: int
    """Index of the shown environment."""
    num_envs: int
    episode_s: float
    """Time since the shown episode began [s]."""
    reward: float
    """Reward of the last step in the shown environment."""
    conditions: Sequence[str]
    """Text for each success condition of the shown environment, with its value and bound."""
    episode_return: float
    """Sum of the rewards of the shown episode so far."""
    episodes: int
    """Number of episodes of the shown environment that have ended."""
    succeeded: int
    """Number of episodes of the shown environment that have ended with success."""
    last_episode: str
    """Text about the last episode of the shown environment: return, length and causes of its end; empty without one."""
    curves: RewardCurves
    checkpoint: int | None
    """Checkpoint of the policy, by its number of environment steps; None: the policy has no checkpoint."""
    checkpoints: tuple[int, ...]
    """Number of environment steps of each of the run's checkpoints, ascending."""
    follow: bool
    """Whether the playback switches to each new checkpoint when it appears."""
    knobs: tuple[Knob, ...]
    """Elements of the task's commands that the user can set, such as the velocity `vx`, each with its range."""
    commands: tuple[float, ...]
    """Present value of each item of `knobs` in the shown environment."""
    held: Mapping[str, float]
    """Name of each item of `knobs` that the user holds at a value -> value."""
    knob: int
    """Index of the item of `knobs` that the keys change."""
    message: str
    """Last message for the user; empty if there is none."""

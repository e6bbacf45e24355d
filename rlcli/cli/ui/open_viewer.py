"""Choice and opening of the viewer for `rlcli play`, and the check of its options --viewer, --port and --command."""

from __future__ import annotations

import importlib
import math
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rlcli.cli.ui.console import console
from rlcli.errors import DependencyError, MachineError, UsageError, require_known
from rlcli.progress import track
from rlcli.safe_text import float_or_nan
from rlcli.settings import setting
from rlcli.viewer.protocol import DEFAULT_PORT, VIEWERS, Viewer

if TYPE_CHECKING:
    from rlcli.evaluation.session import Session
    from rlcli.viewer.playback import Playback

CHOICES = ("auto", *VIEWERS, "none")
"""Values of --viewer."""
Choice = tuple[str, str]
"""Name of a viewer (or none), and the reason for choosing it, which `play` prints."""


def require_viewer(viewer: str | None, port: int | None, *, to_file: bool) -> None:
    """Check that --viewer and --port do not contradict other options.

    Args:
        viewer: the value of --viewer.
        port: the value of --port.
        to_file: whether --video or --record writes a file, so that no viewer opens.

    Raises:
        UsageError: for --viewer with --video or --record, or --port without the web viewer.
    """
    if viewer is not None:
        require_known(viewer, CHOICES, "viewer", "viewers")
    if to_file and viewer in VIEWERS:
        raise UsageError(
            f"--viewer {viewer} opens a viewer, but --video and --record only write files", hint="leave out --viewer"
        )
    if port is not None and (to_file or viewer not in (None, "auto", "web")):
        hint = "leave out --port" if to_file else "write --viewer web, or leave out --port"
        raise UsageError("--port sets the port of the web viewer, which is not opened here", hint=hint)


def read_commands(texts: Sequence[str]) -> dict[str, float]:
    """Parse the values of --command, such as `vx=0.5,wz=0`: name of a command -> value.

    Raises:
        UsageError: for a part that is not NAME=NUMBER, or whose number is not finite.
    """
    values = {}
    for part in ",".join(texts).split(",") if texts else ():
        name, _, text = part.partition("=")
        values[name.strip()] = float_or_nan(text)
        if not math.isfinite(values[name.strip()]):
            raise UsageError(f"--command '{part}' is not NAME=NUMBER", hint="for example: --command vx=0.5,wz=0")
    return values


def choose_viewers(viewer: str | None, port: int | None, *, headless: bool) -> list[Choice]:
    """Return the viewers that `show` tries in this order, until one opens.

    Args:
        viewer: the value of --viewer; None: the viewer in the user's settings, if there is one, else as for auto.
        port: the value of --port.
        headless: whether opening a viewer is forbidden.

    Raises:
        MachineError: for --viewer native without a display.
    """
    from rlcli.sim.gl import has_display

    if viewer == "native" and not has_display():
        raise MachineError(
            "there is no display for a window",
            hint="--viewer web opens the browser, --video FILE.mp4 renders to a file, --viewer none prints values",
        )
    if viewer not in (None, "auto"):
        return [(str(viewer), "--viewer is given")]
    if headless:
        return [("none", "no viewer is needed")]
    if port is not None:
        return [("web", "--port is given")]
    if console.json:
        return [("none", "--json is given without --viewer")]
    preferred = setting("viewer") if viewer is None else None
    if preferred in (*VIEWERS, "none") and (preferred != "native" or has_display()):
        return [(preferred, "viewer in your settings")]
    in_terminal = all(stream is not None and stream.isatty() for stream in (sys.stdin, sys.stdout))
    display = "no display" if not has_display() else "no window"
    fallbacks: list[Choice] = [
        ("none", f"{display}, and not started from a terminal; --viewer web shows the policy in the browser")
    ]
    if in_terminal:
        fallbacks = [("web", f"{display}; --viewer none prints numbers"), ("none", "no viewer works here")]
    return [("native", "there is a display"), *fallbacks] if has_display() else fallbacks


def show(
    session: Session, viewers: Sequence[Choice], *, port: int | None, drawn: int, longest_s: float | None = None
) -> bool:
    """Open the first viewer that works and wait until it is closed.

    Args:
        session: environments and policy.
        viewers: the viewers to try, in this order.
        port: port of the web viewer; None: 8080.
        drawn: number of environments to show.
        longest_s: time after which the viewer closes [s]; None: no limit.

    Returns:
        Whether a viewer was opened; False for the viewer none, for which the caller prints values.

    Raises:
        MachineError, DependencyError: if the last viewer does not work.
    """
    for position, (name, reason) in enumerate(viewers):
        if name == "none":
            console.info(f"viewer: none ({reason})")
            return False
        try:
            with track("viewer", has_own_view=True):
                _open(session, name, reason, port, drawn, longest_s)
        except (MachineError, DependencyError) as error:
            if position + 1 == len(viewers):
                raise
            console.info(f"viewer: {name} does not work: {error.message}{f'; {error.hint}' if error.hint else ''}")
            continue
        return True
    raise AssertionError("bug in rlcli: there is no viewer to try")


def _open(session: Session, name: str, reason: str, port: int | None, drawn: int, longest_s: float | None) -> None:
    """Show the policy in the viewer `name` until it is closed, then print the JSON document."""
    module, _, function = VIEWERS[name].partition(":")
    run: Viewer = getattr(importlib.import_module(module), function)
    playback, address = _playback(session), None
    playback.longest_s = longest_s

    def ready(instructions: Sequence[str], url: str | None) -> None:
        nonlocal address
        address = url
        if url is not None and console.quiet and not console.json:
            console.data(url)
        first, *others = instructions
        console.info(f"viewer: {name} ({reason}){': ' if url else '. '}{first}")
        for line in others:
            console.info(line)

    port = DEFAULT_PORT if port is None else port
    run(playback, title=_title(session), num_drawn=drawn, port=port, ready=ready)
    console.document(
        "play",
        video=None,
        viewer=name,
        reason=reason,
        url=address,
        steps=playback.steps,
        episodes=int(playback.statistics.ended.sum()),
        checkpoint=playback.checkpoint,
        chosen=session.policy.reason,
    )


def _playback(session: Session) -> Playback:
    from rlcli.runs.checkpoint_reader import open_checkpoint
    from rlcli.viewer.checkpoints import RunCheckpoints
    from rlcli.viewer.playback import Playback

    env, policy = session.env, session.policy
    checkpoint_source = step = None
    if policy.run is not None and policy.checkpoint is not None and policy.kind == "trained":
        checkpoint_source = RunCheckpoints(policy.run, env, policy.stochastic, env.seed)
        step = open_checkpoint(policy.checkpoint).step
    env_id, obs = session.start or (0, None)
    return Playback(env, session.act, checkpoint_source, step, shown=env_id, initial_obs=obs)


def _title(session: Session) -> str:
    """Return the title of the viewer: the task and the run, checkpoint or policy."""
    policy = session.policy
    if policy.run is not None and policy.kind == "trained":
        shown = policy.run.folder.name
    else:
        shown = policy.reason if policy.reason and policy.kind == "trained" else f"policy {policy.kind}"
    return f"{policy.resolved.source.name}, {shown}"

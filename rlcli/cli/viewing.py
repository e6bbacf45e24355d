"""Which viewer `play` opens, and why; what it is told, and what it says in the end."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rlcli.cli.console import console

VIEWERS = ("auto", "native", "web", "none")
Choice = tuple[str, str]
"""A viewer, and why it."""


def require_viewer(viewer: str | None, port: int | None, *, drawn: bool) -> None:
    """Refuse flags that contradict each other.

    Raises:
        UsageError: naming both.
    """
    from rlcli.errors import UsageError, did_you_mean

    if viewer is not None and viewer not in VIEWERS:
        near = did_you_mean(viewer, VIEWERS)
        raise UsageError(f"no viewer '{viewer}'", hint=near or f"viewers: {', '.join(VIEWERS)}")
    if drawn and viewer in ("native", "web"):
        raise UsageError(f"--viewer {viewer} is for watching, --video and --record write files", hint="leave one out")
    if port is not None and (drawn or viewer in ("native", "none")):
        raise UsageError("--port is of the viewer in the browser", hint="--viewer web")


def read_commands(asked: Sequence[str]) -> dict[str, float]:
    """`vx=0.5,wz=0` as names and values.

    Raises:
        UsageError: for anything else.
    """
    from rlcli.errors import UsageError

    values = {}
    for part in ",".join(asked).split(","):
        name, _, text = part.partition("=")
        try:
            values[name.strip()] = float(text)
        except ValueError:
            if part or len(asked):
                raise UsageError(f"--command '{part}' is not NAME=NUMBER", hint="as in --command vx=0.5,wz=0") from None
    return values


def choose_viewers(viewer: str | None, port: int | None, *, headless: bool) -> list[Choice]:
    """The viewers to try, in this order; the last one always works or says why it does not. None: the user's settings
    may say which.

    Raises:
        MachineError: if a window is wanted, and there is no display.
    """
    from rlcli.config.settings import setting
    from rlcli.errors import MachineError
    from rlcli.sim.gl import has_display

    if viewer == "native" and not has_display():
        raise MachineError(
            "there is no display for a window",
            hint="--viewer web shows it in the browser, --video FILE.mp4 draws offscreen, --viewer none prints numbers",
        )
    if viewer not in (None, "auto"):
        return [(str(viewer), "as asked")]
    if headless:
        return [("none", "nothing is to be opened")]
    if port is not None:
        return [("web", "--port is given")]
    if console.json:
        return [("none", "with --json nothing is opened unasked")]
    preferred = setting("viewer") if viewer is None else None
    if preferred in ("web", "none") or (preferred == "native" and has_display()):
        return [(preferred, "as your settings say")]
    watched = all(stream is not None and stream.isatty() for stream in (sys.stdin, sys.stdout))
    display = "no display" if not has_display() else "no window"
    after: list[Choice] = [("none", f"{display}, and no terminal asks; --viewer web shows it in the browser")]
    if watched:
        after = [("web", f"{display}; --viewer none prints numbers"), ("none", "nothing else works here")]
    return [("native", "there is a display"), *after] if has_display() else after


def show(session: Any, viewers: Sequence[Choice], *, port: int | None, together: int, stochastic: bool) -> bool:
    """Open the first viewer that works and stay until it is closed; False: numbers are what is left.

    Raises:
        MachineError, DependencyError: if the last one does not work.
    """
    from rlcli.errors import DependencyError, MachineError

    for place, (name, reason) in enumerate(viewers):
        if name == "none":
            console.info(f"viewer: none ({reason})")
            return False
        try:
            _open(session, name, reason, port, together, stochastic)
        except (MachineError, DependencyError) as error:
            if place + 1 == len(viewers):
                raise
            console.info(f"viewer: not {name}: {error.message}{f'; {error.hint}' if error.hint else ''}")
            continue
        return True
    raise AssertionError("there is always a viewer")


def _open(session: Any, name: str, reason: str, port: int | None, together: int, stochastic: bool) -> None:
    from rlcli.rl.checkpoint import open_checkpoint
    from rlcli.viewer.player import Player
    from rlcli.viewer.shelf import RunShelf

    env, run = session.env, session.run
    trained = run is not None and session.policy == "trained"
    shelf = RunShelf(run, env, stochastic, env.seed) if trained else None
    step = open_checkpoint(session.checkpoint).step if trained else None
    shown, begun = session.begun or (0, None)
    player = Player(env, session.act, shelf, step, console.info, shown=shown, begun=begun)
    task = session.resolved.source.name
    url = None
    if name == "native":
        from rlcli.viewer import native

        native.run(player, together, lambda: console.info(f"viewer: native ({reason}). {native.KEYS}"))
    else:
        from rlcli.viewer import web

        def ready(address: str) -> None:
            nonlocal url
            url = address
            if console.quiet and not console.json:
                console.data(url)
            console.info(f"viewer: web ({reason}): open {url} in a browser of this machine; Ctrl-C ends it")
            command = web.tunnel_here(url)
            if command is not None:
                console.info(f"from where you came over SSH: {command}, then open http://localhost:{url.split(':')[2]}")

        acting = session.chosen if session.chosen and session.policy == "trained" else f"policy {session.policy}"
        where = f"{task}, {Path(run.folder).name}" if trained else f"{task}, {acting}"
        web.run(player, port=web.PORT if port is None else port, title=where, together=together, ready=ready)
    console.document(
        "play",
        video=None,
        viewer=name,
        reason=reason,
        url=url,
        steps=player.steps,
        episodes=int(player.ended.sum()),
        checkpoint=player.checkpoint,
        chosen=session.chosen,
    )

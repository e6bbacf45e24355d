"""An environment in the browser, with MuJoCo's own web viewer."""

from __future__ import annotations

import contextlib
import copy
import getpass
import os
import shlex
import threading
import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from rlcli.errors import RlcliError
from rlcli.viewer.crowd import Crowd
from rlcli.viewer.player import Player
from rlcli.viewer.studio import fenced, listen, load, misfit, prove
from rlcli.viewer.video import free_camera

PORT = 8080
_FRAME = 1.0 / 60.0
_REREAD = 1.0
"""How often the list of checkpoints is read again [s]."""
_LOOKS = (
    *("geom_size", "geom_pos", "geom_quat", "geom_rgba", "geom_type", "geom_dataid", "geom_matid", "mat_", "light_"),
    *("site_size", "site_pos", "site_quat", "site_rgba", "body_pos", "body_quat", "jnt_pos", "jnt_axis", "qpos0"),
)
"""How the names of those model fields begin that a picture shows."""


def run(player: Player, *, port: int, title: str, together: int = 1, ready: Callable[[str], None]) -> None:
    """Play until the page's Quit, or an exception such as Ctrl-C; then nothing listens any more.

    Args:
        player: what is played.
        port: on the loopback interface; 0: a free one.
        title: what the page says is played.
        together: how many environments are drawn.
        ready: hears the address, once the page can be opened.

    Raises:
        DependencyError: if MuJoCo's viewer is not the one that is known.
        MachineError: if the port is taken.
    """
    studio = load()
    with listen(port) as listener, fenced(studio, listener):
        port = listener.getsockname()[1]
        stage = _Stage(studio, player, title, together)
        try:
            prove(port)
            stage.require()
            ready(f"http://127.0.0.1:{port}/")
            _loop(stage)
        finally:
            stage.close()


def tunnel_here(url: str) -> str | None:
    """The command that brings the page to where somebody came from over SSH; None: nobody did."""
    said = os.environ.get("SSH_CONNECTION", "").split()
    if len(said) != 4:
        return None
    port = url.rstrip("/").rpartition(":")[2]
    try:
        user = getpass.getuser()
    except (OSError, KeyError, ImportError):  # a number without a name
        user = "USER"
    return f"ssh -N -L {port}:127.0.0.1:{port} {shlex.quote(f'{user}@{said[2]}')}"


class _Stage:
    """The viewer's thread, and the way to it."""

    def __init__(self, studio: Any, player: Player, title: str, together: int) -> None:
        from rlcli.viewer.panel import Panel

        self.player, self._studio = player, studio
        self._error: BaseException | None = None
        self._far, self._near = studio.launch_thread.make_thread_endpoints()
        env = player.env
        self.crowd = Crowd(env, together)
        camera = self.crowd.stand_back(free_camera(env.config.viewer))
        self.panel = Panel(player, title, camera, env.origins.double().cpu().numpy())
        self._shown = player.shown
        self._beside = mujoco.MjvScene(env.engine.model, maxgeom=studio.state_payload.MAX_EXTRA_GEOMS)
        model = copy.deepcopy(env.world(player.shown)[0])
        config = studio.viewer_protocol.ViewerConfig(title="rlcli", gfx="web", http_port=0)
        self._thread = threading.Thread(target=self._watch, args=(config, model), name="viewer", daemon=True)
        self._thread.start()

    def _watch(self, config: Any, model: mujoco.MjModel) -> None:
        try:
            viewer = self._studio.web_viewer.WebViewer(config, self._far, model=model, plugins=[self.panel])
            self._studio.viewer_protocol.run_viewer_loop(viewer)
        except BaseException as error:
            self._error = error

    def is_open(self) -> bool:
        """Whether the viewer still runs."""
        self._near.get_viewer_events()
        self._near.get_viewer_snapshots()
        return self._thread.is_alive()

    def require(self) -> None:
        """Raise what has ended the viewer.

        Raises:
            DependencyError: if it was not the page's Quit.
        """
        if self._error is not None and not isinstance(self._error, RlcliError):
            raise misfit(f"{type(self._error).__name__}: {self._error}") from self._error

    def send(self) -> None:
        """Have the page draw what is."""
        model, data = self.player.env.world(self.player.shown)
        if self._shown != self.player.shown:
            self._shown = self.player.shown
            if any(name.startswith(_LOOKS) for name in self.player.env.engine.expansions()):
                self._near.send_to_viewer(self._studio.messages.ModelEvent(model=copy.deepcopy(model)))
        kind = int(mujoco.mjtState.mjSTATE_INTEGRATION)
        state = np.empty(mujoco.mj_stateSize(model, kind))
        mujoco.mj_getState(model, data, state, kind)
        self._near.send_to_viewer(self._studio.messages.StateSnapshot(state=state, state_sig=kind))
        self.panel.ghosts = list(self.crowd.geoms(self._beside, self.player.shown, mujoco.MjvOption()))

    def close(self) -> None:
        """End the viewer; its server is gone when this returns."""
        with contextlib.suppress(Exception):
            self._near.send_to_viewer(self._studio.messages.ExitEvent())
        self._thread.join(timeout=10.0)


def _loop(stage: _Stage) -> None:
    player = stage.player
    before, read = time.perf_counter(), 0.0
    while stage.is_open():
        now = time.perf_counter()
        if now - read > _REREAD:
            player.reread()
            read = now
        player.advance(now - before)
        before = now
        stage.send()
        time.sleep(max(0.0, _FRAME - (time.perf_counter() - now)))
    stage.require()

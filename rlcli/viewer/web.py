"""Viewer in the browser (`rlcli play --viewer web`): MuJoCo's web viewer, with access control."""

import contextlib
import copy
import getpass
import os
import shlex
import threading
from typing import Any

import mujoco
import numpy as np

from rlcli.errors import RlcliError
from rlcli.viewer.env_grid import EnvGrid
from rlcli.viewer.offscreen import free_camera
from rlcli.viewer.playback import Playback, run_in_real_time
from rlcli.viewer.protocol import Ready
from rlcli.viewer.secured_web_server import (
    import_web_viewer,
    incompatible_viewer,
    listen,
    secured_server,
    verify_refusals,
)

_VISIBLE_FIELDS = (
    *("geom_size", "geom_pos", "geom_quat", "geom_rgba", "geom_type", "geom_dataid", "geom_matid", "mat_", "light_"),
    *("site_size", "site_pos", "site_quat", "site_rgba", "body_pos", "body_quat", "jnt_pos", "jnt_axis", "qpos0"),
)
"""First parts of the names of model fields that change the image, such as colours and sizes of geoms."""


def run(playback: Playback, *, title: str, num_drawn: int = 1, port: int, ready: Ready) -> None:
    """Play in real time until the user chooses Quit in the page; see `rlcli.viewer.protocol.Viewer`.

    Raises:
        DependencyError: if the installed MuJoCo has no web viewer, or a version of it that is not supported.
        MachineError: if the port is in use.
    """
    studio = import_web_viewer()
    with listen(port) as listener, secured_server(studio, listener):
        port = listener.getsockname()[1]
        viewer = _ViewerThread(studio, playback, title, num_drawn)
        try:
            verify_refusals(port)
            viewer.raise_error()
            instructions = [f"open http://127.0.0.1:{port}/ in a browser on this machine; Ctrl-C ends the viewer"]
            tunnel = ssh_tunnel_command(port)
            if tunnel is not None:
                there = f"run {tunnel}, then open http://localhost:{port}/ there"
                instructions.append(f"on the machine from which you connect by SSH: {there}")
            ready(instructions, f"http://127.0.0.1:{port}/")
            run_in_real_time(playback, viewer.is_open, viewer.send)
            viewer.raise_error()
        finally:
            viewer.close()


def ssh_tunnel_command(port: int) -> str | None:
    """Return the `ssh -L` command that forwards a port to the user's machine; None outside an SSH session."""
    connection = os.environ.get("SSH_CONNECTION", "").split()
    if len(connection) != 4:
        return None
    try:
        user = getpass.getuser()
    except (OSError, KeyError, ImportError):  # the operating system has no name for this user id
        user = "USER"
    return f"ssh -N -L {port}:127.0.0.1:{port} {shlex.quote(f'{user}@{connection[2]}')}"


class _ViewerThread:
    """Thread that runs MuJoCo's web viewer; `send` gives the thread the state to show.

    Args:
        studio: the viewer's modules, from `import_web_viewer`.
        playback: environments and policy.
        title: task and run, for the user.
        num_drawn: number of environments in the image.
    """

    def __init__(self, studio: Any, playback: Playback, title: str, num_drawn: int) -> None:
        from rlcli.viewer.web_panel import WebPanel

        self.playback, self._studio = playback, studio
        self._error: BaseException | None = None
        self._viewer_endpoint, self._endpoint = studio.launch_thread.make_thread_endpoints()
        env = playback.env
        self.env_grid = EnvGrid(env, num_drawn)
        camera = self.env_grid.fit_camera(free_camera(env.config.viewer))
        self.panel = WebPanel(playback, title, camera, env.origins.double().cpu().numpy())
        self._shown = playback.shown
        self._overlay_scene = mujoco.MjvScene(env.engine.model, maxgeom=studio.state_payload.MAX_EXTRA_GEOMS)
        model = copy.deepcopy(env.world(playback.shown)[0])
        config = studio.viewer_protocol.ViewerConfig(title="rlcli", gfx="web", http_port=0)
        self._thread = threading.Thread(target=self._run, args=(config, model), name="viewer", daemon=True)
        self._thread.start()

    def _run(self, config: Any, model: mujoco.MjModel) -> None:
        try:
            viewer = self._studio.web_viewer.WebViewer(config, self._viewer_endpoint, model=model, plugins=[self.panel])
            self._studio.viewer_protocol.run_viewer_loop(viewer)
        except BaseException as error:
            self._error = error

    def is_open(self) -> bool:
        """Return whether the viewer still runs; also empty its event queues, which would otherwise grow."""
        self._endpoint.get_viewer_events()
        self._endpoint.get_viewer_snapshots()
        return self._thread.is_alive()

    def raise_error(self) -> None:
        """Raise an error if MuJoCo's viewer has ended the thread with an error other than an `RlcliError`.

        Raises:
            DependencyError: if MuJoCo's viewer has raised an error.
        """
        if self._error is not None and not isinstance(self._error, RlcliError):
            raise incompatible_viewer(f"{type(self._error).__name__}: {self._error}") from self._error

    def send(self) -> None:
        """Send the current state of the shown environment to the page."""
        model, data = self.playback.env.world(self.playback.shown)
        if self._shown != self.playback.shown:
            self._shown = self.playback.shown
            if any(name.startswith(_VISIBLE_FIELDS) for name in self.playback.env.engine.expanded_fields()):
                self._endpoint.send_to_viewer(self._studio.messages.ModelEvent(model=copy.deepcopy(model)))
        kind = int(mujoco.mjtState.mjSTATE_INTEGRATION)
        state = np.empty(mujoco.mj_stateSize(model, kind))
        mujoco.mj_getState(model, data, state, kind)
        self._endpoint.send_to_viewer(self._studio.messages.StateSnapshot(state=state, state_sig=kind))
        overlay = self.env_grid.geoms(self._overlay_scene, self.playback.shown, mujoco.MjvOption())
        self.panel.overlay_geoms = list(overlay)

    def close(self) -> None:
        """End the viewer and its server."""
        with contextlib.suppress(Exception):
            self._endpoint.send_to_viewer(self._studio.messages.ExitEvent())
        self._thread.join(timeout=10.0)

"""Viewer in a window (`rlcli play --viewer native`): MuJoCo's passive viewer, with keyboard controls."""

import copy
import sys
import threading
import warnings
from functools import partial
from typing import Any

import mujoco
import numpy as np

from rlcli.errors import MachineError
from rlcli.viewer.env_grid import EnvGrid
from rlcli.viewer.offscreen import free_camera
from rlcli.viewer.playback import Playback, run_in_real_time
from rlcli.viewer.protocol import REQUEST_KEYS, Ready, View

KEYS = (
    "Space: pause, resume. Right: one step. Backspace: new episodes. - and =: speed. Up, Down: environment."
    " PageUp, PageDown: newer, older checkpoint. Home, End: choose a command; Insert, Delete: raise, lower the command."
    " Double click, then Ctrl and drag: push a body"
)
_REQUESTS = {code: request for request, (code, _) in REQUEST_KEYS.items()}
"""Key code of GLFW (the window library) -> name of the request that the key submits, as in `Playback.requests`."""


def run(playback: Playback, *, title: str, num_drawn: int, port: int, ready: Ready) -> None:
    """Play in real time until the window is closed; see `rlcli.viewer.protocol.Viewer`.

    Raises:
        MachineError: if no window can be opened, for example without a display, or on macOS without mjpython.
    """
    import mujoco.viewer

    _require_windows()
    env = playback.env
    env_grid = EnvGrid(env, num_drawn)
    shown = playback.shown
    model = copy.deepcopy(env.world(shown)[0])
    data = mujoco.MjData(model)
    before = set(threading.enumerate())
    try:
        handle = mujoco.viewer.launch_passive(model, data, key_callback=partial(press, playback), show_left_ui=False)
    except RuntimeError as error:
        start = "start it as `mjpython -m rlcli play ...`, or " if sys.platform == "darwin" else ""
        raise MachineError(f"the window cannot be opened: {error}", hint=f"{start}add --viewer web") from error
    drawing = set(threading.enumerate()) - before
    try:
        with handle as window:
            camera = env_grid.fit_camera(free_camera(env.config.viewer, env.origins[shown].tolist()), shown)
            window.cam.lookat[:], window.cam.distance = camera.lookat, camera.distance
            window.cam.azimuth, window.cam.elevation = camera.azimuth, camera.elevation
            ready([KEYS], None)

            def draw() -> None:
                _draw(window, playback, env_grid, model, data)
                playback.push(_forces(window, model, data))

            run_in_real_time(playback, window.is_running, draw)
    finally:
        for thread in drawing:  # the process would crash if it exits while one of these threads draws
            thread.join(timeout=5.0)


def press(playback: Playback, code: int) -> None:
    """Submit the request that belongs to a pressed key to the playback; other keys do nothing.

    `code` is the key's code in GLFW (the window library).
    """
    if code in _REQUESTS:
        playback.submit(playback.requests()[_REQUESTS[code]])


def captions(view: View) -> tuple[str, str]:
    """Return the two columns of text in the corner of the window: names, and their values; one line for each."""
    rows = {
        "speed": "paused" if view.paused else f"{view.speed:g} x",
        "environment": f"{view.shown} of {view.num_envs}",
        "episode": f"{view.episodes}, {view.episode_s:.2f} s",
        "return": f"{view.episode_return:.4g}",
        "reward": f"{view.reward:.4g}",
    }
    for condition in view.conditions:
        name, _, state = condition.partition(" ")
        rows[f"success: {name}"] = state
    if view.checkpoint is not None:
        rows["checkpoint"] = f"{view.checkpoint}"
    if view.last_episode:
        rows["last episode"] = view.last_episode
    for number, (knob, command) in enumerate(zip(view.knobs, view.commands, strict=True)):
        value = f"{view.held[knob.name]:g}" if knob.name in view.held else f"{command:.2f} from the task"
        rows[f"{'> ' if number == view.knob else ''}{knob.label}"] = value
    if view.message:
        rows[""] = view.message[:80]
    return "\n".join(rows), "\n".join(rows.values())


def _require_windows() -> None:
    """Check that a window can be opened. Otherwise MuJoCo's thread would wait for the window forever.

    Raises:
        MachineError: if no window can be opened, for example without a display.
    """
    if sys.platform == "darwin":  # on macOS only the main thread may open a window; MuJoCo raises an error otherwise
        return
    import glfw

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        window = None
        if glfw.init():
            glfw.window_hint(glfw.VISIBLE, False)
            window = glfw.create_window(16, 16, "rlcli", None, None)
            glfw.default_window_hints()
    if window is None:
        messages = [" ".join(str(warning.message).split()) for warning in caught]
        why = "; ".join(messages) or "GLFW does not start"
        hint = "--viewer web opens the browser, --video FILE.mp4 renders to a file"
        raise MachineError(f"the window cannot be opened: {why}", hint=hint)
    glfw.destroy_window(window)


def _draw(window: Any, playback: Playback, env_grid: EnvGrid, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Copy the state of the shown environment into `data`, which the window shows, and redraw the window."""
    _, now = playback.env.world(playback.shown)
    with window.lock():
        mujoco.mj_copyData(data, model, now)
        window.user_scn.ngeom = 0
        env_grid.add(window.user_scn, playback.shown, window.opt)
    names, values = captions(playback.view)
    window.set_texts((mujoco.mjtFontScale.mjFONTSCALE_150, mujoco.mjtGridPos.mjGRID_TOPLEFT, names, values))
    window.sync()


def _forces(window: Any, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Return the forces and torques on the bodies from the user's mouse, world frame. (nbody, 6) [N, N m]"""
    with window.lock():
        data.xfrc_applied[:] = 0.0
        if window.perturb.active:
            mujoco.mjv_applyPerturbForce(model, data, window.perturb)
        return np.array(data.xfrc_applied)

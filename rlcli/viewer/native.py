"""A window on the environments, MuJoCo's own passive viewer."""

from __future__ import annotations

import copy
import sys
import threading
import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import mujoco
import numpy as np

from rlcli.errors import MachineError
from rlcli.viewer.crowd import Crowd
from rlcli.viewer.player import Player, View
from rlcli.viewer.video import free_camera

KEYS = (
    "Space: pause, go on. Right: one step. Backspace: new episodes. - and =: speed. Up, Down: environment."
    " PageUp, PageDown: newer, older checkpoint. Home, End: choose a command; Insert, Delete: raise, lower it."
    " Double click, then Ctrl and drag: push a body"
)
_SPACE, _BACKSPACE, _MINUS, _EQUAL = 32, 259, 45, 61
_RIGHT, _DOWN, _UP, _PAGE_UP, _PAGE_DOWN = 262, 264, 265, 266, 267
_INSERT, _DELETE, _HOME, _END = 260, 261, 268, 269
_FRAME = 1.0 / 60.0
_REREAD = 1.0


def run(player: Player, together: int, ready: Callable[[], None]) -> None:
    """Play in real time until the window is closed.

    Args:
        player: what is played.
        together: how many environments are drawn.
        ready: called when the window is open.

    Raises:
        MachineError: if no window opens, as on macOS outside mjpython.
    """
    import mujoco.viewer

    _require_windows()
    env = player.env
    crowd = Crowd(env, together)
    shown = player.shown
    model = copy.deepcopy(env.world(shown)[0])
    data = mujoco.MjData(model)
    before = set(threading.enumerate())
    try:
        handle = mujoco.viewer.launch_passive(model, data, key_callback=partial(press, player), show_left_ui=False)
    except RuntimeError as error:
        hint = "start it as: mjpython -m rlcli play ..., or --viewer web" if sys.platform == "darwin" else None
        raise MachineError(f"the window cannot be opened: {error}", hint=hint) from error
    drawing = set(threading.enumerate()) - before
    try:
        with handle as window:
            camera = crowd.stand_back(free_camera(env.config.viewer, env.origins[shown].tolist()), shown)
            window.cam.lookat[:], window.cam.distance = camera.lookat, camera.distance
            window.cam.azimuth, window.cam.elevation = camera.azimuth, camera.elevation
            ready()
            _loop(window, player, crowd, model, data)
    finally:
        for thread in drawing:  # a process that ends while it draws crashes
            thread.join(timeout=5.0)


def press(player: Player, code: int) -> None:
    """What a key of the window (GLFW's number) asks of the player."""
    view = player.view
    asked: dict[int, Callable[[], None]] = {
        _SPACE: partial(player.pause, not view.paused),
        _RIGHT: player.single_step,
        _BACKSPACE: player.reset,
        _MINUS: partial(player.faster, -1),
        _EQUAL: partial(player.faster, 1),
        _UP: partial(player.show, view.shown + 1),
        _DOWN: partial(player.show, view.shown - 1),
        _PAGE_UP: partial(player.neighbour, 1),
        _PAGE_DOWN: partial(player.neighbour, -1),
        _HOME: partial(player.choose_knob, -1),
        _END: partial(player.choose_knob, 1),
        _INSERT: partial(player.turn_knob, 1),
        _DELETE: partial(player.turn_knob, -1),
    }
    if code in asked:
        player.ask(asked[code])


def captions(view: View) -> tuple[str, str]:
    """What stands in the window's corner: names, and values."""
    rows = {
        "speed": "paused" if view.paused else f"{view.speed:g} x",
        "environment": f"{view.shown} of {view.num_envs}",
        "episode": f"{view.episodes}, {view.episode_s:.2f} s",
        "reward": f"{view.reward:.4g}",
    }
    if view.checkpoint is not None:
        rows["checkpoint"] = f"{view.checkpoint}"
    for place, knob in enumerate(view.knobs):
        asked = f"{view.held[knob.name]:g}" if knob.name in view.held else "as drawn"
        rows[f"{'> ' if place == view.knob else ''}{knob.name}"] = asked
    if view.message:
        rows[""] = view.message[:80]
    return "\n".join(rows), "\n".join(rows.values())


def _require_windows() -> None:
    """MuJoCo opens its window in a thread, and waits for ever for one that does not open.

    Raises:
        MachineError: if the display takes no window.
    """
    if sys.platform == "darwin":  # there a window belongs to the main thread, and MuJoCo says so by itself
        return
    import glfw

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        window = None
        if glfw.init():
            glfw.window_hint(glfw.VISIBLE, False)
            window = glfw.create_window(16, 16, "rlcli", None, None)
            glfw.default_window_hints()
    if window is None:
        why = "; ".join(" ".join(str(warning.message).split()) for warning in said) or "GLFW does not start"
        raise MachineError(
            f"the window cannot be opened: {why}", hint="--viewer web shows it in the browser, --video draws offscreen"
        )
    glfw.destroy_window(window)


def _loop(window: Any, player: Player, crowd: Crowd, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    before, read = time.perf_counter(), 0.0
    while window.is_running():
        now = time.perf_counter()
        if now - read > _REREAD:
            player.reread()
            read = now
        player.advance(now - before)
        before = now
        _draw(window, player, crowd, model, data)
        player.push(_forces(window, model, data))
        time.sleep(max(0.0, _FRAME - (time.perf_counter() - now)))


def _draw(window: Any, player: Player, crowd: Crowd, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Copy the environment that is to be shown into what the window looks at."""
    _, now = player.env.world(player.shown)
    with window.lock():
        mujoco.mj_copyData(data, model, now)
        window.user_scn.ngeom = 0
        crowd.add(window.user_scn, player.shown, window.opt)
    names, values = captions(player.view)
    window.set_texts((mujoco.mjtFontScale.mjFONTSCALE_150, mujoco.mjtGridPos.mjGRID_TOPLEFT, names, values))
    window.sync()


def _forces(window: Any, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """What the person at the window pushes with. (nbody, 6) [N, N m]"""
    with window.lock():
        data.xfrc_applied[:] = 0.0
        if window.perturb.active:
            mujoco.mjv_applyPerturbForce(model, data, window.perturb)
        return np.array(data.xfrc_applied)

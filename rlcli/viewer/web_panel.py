"""Panel of the browser's viewer: the controls beside the scene, and the keys.

The panel runs in the viewer's thread. It reads the playback's view and submits requests; it changes nothing else. The
force on a dragged body is applied in the simulation; other edits in the page have no effect on it.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar, cast

import mujoco
import numpy as np
from mujoco.studio import messages, plugin, ux
from mujoco.studio.app import inputs
from mujoco.studio.dear_imgui import dear_imgui as imgui

from rlcli.viewer.playback import SPEEDS, Playback
from rlcli.viewer.protocol import REQUEST_KEYS, View

TITLE = "Options"
"""Title of the window that MuJoCo's viewer docks to the left."""
_SPEEDS = ["1/8 x", "1/4 x", "1/2 x", "real time", "2 x", "4 x", "8 x"]
_LAST = 0
"""Priority of handlers that run after those of MuJoCo."""

Method = TypeVar("Method", bound=Callable[..., None])


def _handler(priority: int) -> Callable[[Method], Method]:
    """Return the decorator `messages.handler` with type annotations."""
    return cast("Callable[[Method], Method]", messages.handler(priority=priority))


class WebPanel(plugin.ViewerPlugin):  # type: ignore[misc]  # MuJoCo has no types
    """Panel and keys of the browser's viewer.

    Args:
        playback: the playback that is shown and controlled.
        title: the task and the run.
        camera: initial camera.
        env_origins: origin of each environment in its world. (num_envs, 3) [m]
    """

    def __init__(self, playback: Playback, title: str, camera: mujoco.MjvCamera, env_origins: np.ndarray) -> None:
        self.overlay_geoms: Sequence[mujoco.MjvGeom] = ()
        """Markers and geoms of further environments; the simulation's thread sets them."""
        self._playback, self._title, self._start_camera, self._env_origins = playback, title, camera, env_origins
        self._shown = playback.view.shown
        self._ux = ux.UxState()
        self._pushing = False

    @_handler(_LAST)
    def _on_viewer_init(self, _: plugin.ViewerInitEvent) -> None:
        ux.setup_theme(ux.GuiTheme.LIGHT)
        self._reset_camera()

    @_handler(_LAST)
    def _on_post_model(self, _: messages.PostModelEvent) -> None:
        self.viewer.perturb.select = 0

    @_handler(messages.Priority.USER)
    def _on_theme(self, event: plugin.ThemeEvent) -> None:
        ux.setup_theme(event.theme)

    @_handler(messages.Priority.USER)
    def _on_update(self, _: messages.UpdateEvent) -> None:
        view = self._playback.view
        if view.shown != self._shown:  # on terrain each environment has another origin
            self.viewer.camera.lookat[:] += self._env_origins[view.shown] - self._env_origins[self._shown]
            self._shown = view.shown
        self.viewer.extra_geoms[:] = self.overlay_geoms
        inputs.handle_mouse_events(
            self.viewer.model,
            self.viewer.data,
            self.viewer.camera,
            self.viewer.vis_options,
            self.viewer.perturb,
            self._ux,
            move_camera=self.viewer.client_camera is None,
        )
        self._push()
        self._keys()
        self.viewer.camera_index = self._ux.camera_index

    @_handler(messages.Priority.USER)
    def _on_build_gui(self, _: messages.BuildGuiEvent) -> None:
        view, playback = self._playback.view, self._playback
        area = ux.configure_docking_layout(show_toolbar=False, show_status_bar=False)
        if imgui.BeginMainMenuBar():
            if imgui.BeginMenu("File"):
                if imgui.MenuItem("Quit"):
                    self.viewer.dispatch(messages.ExitEvent())
                imgui.EndMenu()
            imgui.EndMainMenuBar()
        imgui.Begin(TITLE)
        imgui.TextWrapped(self._title)
        for label, request in (("Go on" if view.paused else "Pause", "pause"), ("Step", "step"), ("Reset", "reset")):
            if imgui.Button(label):
                playback.submit(playback.requests()[request])
            imgui.SameLine()
        if imgui.Button("Camera"):
            self._reset_camera()
        imgui.PushItemWidth(imgui.GetContentRegionAvail().x * 0.5)
        changed, index = imgui.Combo("Speed", SPEEDS.index(view.speed), _SPEEDS)
        if changed:
            playback.submit(partial(playback.set_speed, SPEEDS[index]))
        if view.num_envs > 1:
            changed, shown = imgui.SliderInt("Environment", view.shown, 0, view.num_envs - 1)
            if changed:
                playback.submit(partial(playback.show, shown))
        self._checkpoints(view)
        self._commands(view)
        imgui.PopItemWidth()
        imgui.Separator()
        imgui.TextUnformatted(f"episode {view.episodes}, {view.episode_s:.2f} s, reward {view.reward:.4g}")
        for condition in view.conditions:
            imgui.TextUnformatted(f"success: {condition}")
        if view.message:
            imgui.TextWrapped(view.message)
        self._rendering_options()
        imgui.End()
        ux.view_gizmo_gui(self.viewer.model, self.viewer.data, self.viewer.camera, self._ux, area)

    def _checkpoints(self, view: View) -> None:
        if not view.checkpoints:
            return
        playback = self._playback
        if imgui.BeginCombo("Checkpoint", str(view.checkpoint)):
            for step in view.checkpoints:
                name = f"{step}{' (newest)' if step == view.checkpoints[-1] else ''}"
                if imgui.Selectable(name, step == view.checkpoint):
                    playback.submit(partial(playback.switch, step))
            imgui.EndCombo()
        changed, follow = imgui.Checkbox("Play new ones as they appear", view.follow)
        if changed:
            playback.submit(partial(playback.set_follow, follow))

    def _commands(self, view: View) -> None:
        for knob in view.knobs:
            held = knob.name in view.held
            changed, hold = imgui.Checkbox(f"##{knob.name}", held)
            if changed:
                start = min(max(0.0, knob.low), knob.high)
                self._playback.submit(partial(self._playback.hold, knob.name, start if hold else None))
            imgui.SetItemTooltip("Checked: keep this value. Unchecked: the task samples it.")
            imgui.SameLine()
            moved, value = imgui.SliderFloat(knob.name, view.held.get(knob.name, 0.0), knob.low, knob.high)
            if moved:
                self._playback.submit(partial(self._playback.hold, knob.name, value))

    def _rendering_options(self) -> None:
        viewer = self.viewer
        flags = int(imgui.TreeNodeFlags.SpanAvailWidth) | int(imgui.TreeNodeFlags.Framed)
        if imgui.TreeNodeEx("Keys", flags):
            imgui.TextWrapped(KEYS)
            imgui.TreePop()
        if imgui.TreeNodeEx("Rendering", flags):
            ux.rendering_gui(viewer.model, viewer.vis_options, viewer.render_flags)
            imgui.TreePop()
        if imgui.TreeNodeEx("Visibility groups", flags):
            ux.groups_gui(viewer.model, viewer.vis_options)
            imgui.TreePop()

    def _reset_camera(self) -> None:
        """Move the camera to the position in the task's `viewer` settings."""
        camera, begin = self.viewer.camera, self._start_camera
        camera.type, camera.fixedcamid, camera.trackbodyid = int(mujoco.mjtCamera.mjCAMERA_FREE), -1, -1
        camera.lookat[:] = begin.lookat + self._env_origins[self._shown]
        camera.distance, camera.azimuth, camera.elevation = begin.distance, begin.azimuth, begin.elevation
        self._ux.camera_index = ux.TUMBLE_CAMERA_IDX

    def _push(self) -> None:
        """Apply the force on a dragged body in the simulation, until the user releases it."""
        model, data, perturb = self.viewer.model, self.viewer.data, self.viewer.perturb
        if not perturb.active and not self._pushing:
            return
        data.xfrc_applied[:] = 0.0
        if perturb.active:
            mujoco.mjv_applyPerturbForce(model, data, perturb)
        self._pushing = bool(perturb.active)
        self._playback.submit(partial(self._playback.push, data.xfrc_applied.copy()))

    def _keys(self) -> None:
        if imgui.GetIO().WantCaptureKeyboard:
            return
        for request, (_, key) in REQUEST_KEYS.items():
            if key is not None and imgui.IsKeyChordPressed(getattr(imgui.Key, key)):
                self._playback.submit(self._playback.requests()[request])
                return
        is_free_camera = self._ux.camera_index == ux.FREE_CAMERA_IDX
        if not inputs.handle_camera_select_keyboard_events(self.viewer.model, self.viewer.camera, self._ux):
            inputs.handle_vis_options_keyboard_events(self.viewer.vis_options, is_free_camera)


KEYS = (
    "Space: pause, go on. Right: one step. Backspace: new episodes. - and =: speed. Up, Down: environment."
    " PageUp, PageDown: newer, older checkpoint. Escape: free camera. Double click, then Ctrl and drag: push a body."
)

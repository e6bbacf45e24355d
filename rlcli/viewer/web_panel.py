"""Panel of the web viewer: controls beside the scene (buttons, sliders, plots), and keyboard shortcuts.

The panel runs in the viewer's thread; it reads `Playback.view` and submits requests. If the user drags a body, the
force is applied in the simulation; other edits in the page do not change the simulation.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import TypeVar, cast

import mujoco
import numpy as np
from mujoco.studio import messages, plugin, ux
from mujoco.studio.app import inputs
from mujoco.studio.dear_imgui import dear_imgui as imgui
from mujoco.studio.implot import implot

from rlcli.sim.markers import Frame, Marker
from rlcli.viewer.offscreen import followed_body
from rlcli.viewer.playback import SPEEDS, Playback
from rlcli.viewer.protocol import REQUEST_KEYS, View

TITLE = "Options"
"""Title of the window that MuJoCo's viewer docks to the left."""
_SPEEDS = ["1/8 x", "1/4 x", "1/2 x", "real time", "2 x", "4 x", "8 x"]
_WIDTH = 310.0
"""Width of the docked panel [pixels]."""
_NARROW = 2.0 * _WIDTH
"""Width of a page below which the panel covers the lower part of the page, as on a phone [pixels]."""
_LAST = 0
"""Priority, in `messages.handler` of MuJoCo, of event handlers that run after MuJoCo's own."""

Method = TypeVar("Method", bound=Callable[..., None])


def _handler(priority: int) -> Callable[[Method], Method]:
    """Return MuJoCo's decorator `messages.handler`, with types; a decorated method handles events of the page."""
    return cast("Callable[[Method], Method]", messages.handler(priority=priority))


class WebPanel(plugin.ViewerPlugin):  # type: ignore[misc]  # MuJoCo has no types
    """Panel and keys of the web viewer.

    Args:
        playback: the playback that is shown and controlled.
        title: the task and the run.
        camera: initial camera, relative to the shown environment.
        env_origins: origin of each environment, world frame. (num_envs, 3) [m]
    """

    def __init__(self, playback: Playback, title: str, camera: mujoco.MjvCamera, env_origins: np.ndarray) -> None:
        self.overlay_geoms: Sequence[mujoco.MjvGeom] = ()
        """Markers and geoms of further environments; the simulation's thread sets them."""
        self._playback, self._title, self._start_camera, self._env_origins = playback, title, camera, env_origins
        self._followed = followed_body(playback.env.engine.model, playback.env.config.viewer.follow)
        self._last_place = self._env_origins[playback.view.shown]
        self._legend = _legend(playback.env.markers())
        self._ux = ux.UxState()
        self._pushing = False
        self._page_width = 0.0

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
        place = self._followed_point(view.shown)
        self.viewer.camera.lookat[:] += place - self._last_place
        self._last_place = place
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
        self._begin()
        imgui.TextWrapped(self._title)
        for label, request in (("Resume" if view.paused else "Pause", "pause"), ("Step", "step"), ("Reset", "reset")):
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
        self._episode(view)
        self._reward_plot(view)
        if view.message:
            imgui.TextWrapped(view.message)
        self._rendering_options()
        imgui.End()
        ux.view_gizmo_gui(self.viewer.model, self.viewer.data, self.viewer.camera, self._ux, area)

    def _begin(self) -> None:
        """Begin the panel: docked to the left, or on a narrow page in its lower part."""
        page = imgui.GetIO().DisplaySize
        if page.x < _NARROW:
            imgui.SetNextWindowPos(imgui.Vec2(0.0, 0.55 * page.y))
            imgui.SetNextWindowSize(imgui.Vec2(page.x, 0.45 * page.y))
            imgui.Begin(f"{TITLE}###narrow", flags=_FIXED)  # another window than the docked one
            return
        imgui.Begin(TITLE)
        node = imgui.GetWindowDockID()
        if node and page.x != self._page_width:  # the page has opened or changed its width
            self._page_width = page.x
            imgui.DockBuilderSetNodeSize(node, imgui.Vec2(_WIDTH, page.y))

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
        changed, follow = imgui.Checkbox("Play new checkpoints as they appear", view.follow)
        if changed:
            playback.submit(partial(playback.set_follow, follow))

    def _commands(self, view: View) -> None:
        if view.knobs:
            imgui.SeparatorText("Commands")
        for knob, command in zip(view.knobs, view.commands, strict=True):
            changed, hold = imgui.Checkbox(f"hold##{knob.name}", knob.name in view.held)
            imgui.SetItemTooltip("Checked: keep this value. Unchecked: the task samples the value.")
            imgui.SameLine()
            imgui.SetNextItemWidth(imgui.GetContentRegionAvail().x * 0.5)
            moved, value = imgui.SliderFloat(knob.label, command, knob.low, knob.high)
            imgui.SetItemTooltip("Move the slider to hold the command at a value.")
            if changed or moved:
                keep = value if moved else min(max(command, knob.low), knob.high)
                self._playback.submit(partial(self._playback.hold, knob.name, keep if moved or hold else None))
        for meaning, color in self._legend:
            if color is not None:
                imgui.ColorButton(f"##{meaning}", imgui.Vec4(*color), _SWATCH)
                imgui.SameLine()
            imgui.TextWrapped(meaning)

    def _episode(self, view: View) -> None:
        imgui.SeparatorText(f"Episode {view.episodes + 1}")
        imgui.TextWrapped(f"{view.episode_s:.2f} s, return {view.episode_return:.4g}")
        for condition in view.conditions:
            value, _, state = condition.rpartition(": ")
            imgui.TextWrapped(f"success: {value}")
            imgui.BulletText(state)
        if view.last_episode:
            imgui.TextWrapped(f"last episode: {view.last_episode}")
        if view.conditions and view.episodes:
            imgui.TextWrapped(f"{view.succeeded} of {view.episodes} episodes succeeded")

    def _reward_plot(self, view: View) -> None:
        """Plot the reward and its terms over the last seconds; the legend shows the newest values."""
        imgui.SeparatorText("Reward per step")
        size = imgui.Vec2(-1.0, 150.0 + 19.0 * len(view.curves.values))
        flags = int(implot.Flags.NoTitle) | int(implot.Flags.NoMenus) | int(implot.Flags.NoMouseText)
        if not view.curves.values or not implot.BeginPlot("##rewards", size, flags):
            return
        fit = int(implot.AxisFlags.AutoFit)
        implot.SetupAxes("time [s]", "", fit, fit)
        implot.SetupLegend(int(implot.Location.South), int(implot.LegendFlags.Outside))
        for name, values in view.curves.values:
            implot.PlotLine(f"{name} {values[-1]:.3g}###{name}", view.curves.time_s, values)
        implot.EndPlot()

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
        camera.lookat[:] = begin.lookat + self._last_place
        camera.distance, camera.azimuth, camera.elevation = begin.distance, begin.azimuth, begin.elevation
        self._ux.camera_index = ux.TUMBLE_CAMERA_IDX

    def _followed_point(self, shown: int) -> np.ndarray:
        """Return the point that the camera follows: the environment's origin, or how far `viewer.follow` has moved from
        its default position. (3,) [m]
        """
        if self._followed is None:
            return np.asarray(self._env_origins[shown])
        body, start = self._followed
        return np.asarray(self.viewer.data.xpos[body] - start)

    def _push(self) -> None:
        """Apply the force on a dragged body in the simulation, until the user releases the body."""
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


def _legend(markers: Sequence[Marker]) -> list[tuple[str, Sequence[float] | None]]:
    """Return (label, colour) of each marker; the colour of a frame is None, because its axes have three colours."""
    entries = [
        (f"{m.label}: x red, y green, z blue", None) if isinstance(m, Frame) else (m.label, m.color) for m in markers
    ]
    return list(dict.fromkeys(entries))


_FIXED = int(imgui.WindowFlags.NoDocking) | int(imgui.WindowFlags.NoDecoration) & ~int(imgui.WindowFlags.NoScrollbar)
_SWATCH = int(imgui.ColorEditFlags.NoTooltip)
KEYS = (
    "Space: pause, resume. Right: one step. Backspace: new episodes. - and =: speed. Up, Down: environment."
    " PageUp, PageDown: newer, older checkpoint. Escape: free camera. Double click, then Ctrl and drag: push a body."
)

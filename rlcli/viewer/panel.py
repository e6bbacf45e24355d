"""The panel of the browser's viewer: what MuJoCo's web viewer draws beside the scene, and its keys.

Runs in the viewer's thread. It looks at the player's view and asks it things, and changes nothing else: a body that is
dragged pushes on the simulation, and what else the page may edit never reaches it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import mujoco
import numpy as np
from mujoco.studio import messages, plugin, ux
from mujoco.studio.app import inputs
from mujoco.studio.dear_imgui import dear_imgui as imgui

from rlcli.viewer.player import SPEEDS, Player, View

TITLE = "Options"
"""The window that the viewer docks to the left."""
_SPEEDS = ["1/8 x", "1/4 x", "1/2 x", "real time", "2 x", "4 x", "8 x"]
_LAST = 0
"""Handlers of this priority run when those of MuJoCo have."""


class Panel(plugin.ViewerPlugin):
    """The panel.

    Args:
        player: what it shows and asks.
        title: the task and the run.
        camera: where the viewer begins.
        places: where each environment starts in its world. (num_envs, 3) [m]
    """

    def __init__(self, player: Player, title: str, camera: mujoco.MjvCamera, places: np.ndarray) -> None:
        self.ghosts: Sequence[mujoco.MjvGeom] = ()
        """Markers, and geoms of further environments, set by the simulation's thread."""
        self._player, self._title, self._begin, self._places = player, title, camera, places
        self._shown = player.view.shown
        self._ux = ux.UxState()
        self._pushing = False

    @messages.handler(priority=_LAST)
    def _on_viewer_init(self, _: plugin.ViewerInitEvent) -> None:
        ux.setup_theme(ux.GuiTheme.LIGHT)
        self._aim()

    @messages.handler(priority=_LAST)
    def _on_post_model(self, _: messages.PostModelEvent) -> None:
        self.viewer.perturb.select = 0

    @messages.handler(priority=messages.Priority.USER)
    def _on_theme(self, event: plugin.ThemeEvent) -> None:
        ux.setup_theme(event.theme)

    @messages.handler(priority=messages.Priority.USER)
    def _on_update(self, _: messages.UpdateEvent) -> None:
        view = self._player.view
        if view.shown != self._shown:  # on terrain another environment is elsewhere
            self.viewer.camera.lookat[:] += self._places[view.shown] - self._places[self._shown]
            self._shown = view.shown
        self.viewer.extra_geoms[:] = self.ghosts
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
        self._keys(view)
        self.viewer.camera_index = self._ux.camera_index

    @messages.handler(priority=messages.Priority.USER)
    def _on_build_gui(self, _: messages.BuildGuiEvent) -> None:
        view, player = self._player.view, self._player
        area = ux.configure_docking_layout(show_toolbar=False, show_status_bar=False)
        if imgui.BeginMainMenuBar():
            if imgui.BeginMenu("File"):
                if imgui.MenuItem("Quit"):
                    self.viewer.dispatch(messages.ExitEvent())
                imgui.EndMenu()
            imgui.EndMainMenuBar()
        imgui.Begin(TITLE)
        imgui.TextWrapped(self._title)
        if imgui.Button("Go on" if view.paused else "Pause"):
            player.ask(partial(player.pause, not view.paused))
        imgui.SameLine()
        if imgui.Button("Step"):
            player.ask(player.single_step)
        imgui.SameLine()
        if imgui.Button("Reset"):
            player.ask(player.reset)
        imgui.SameLine()
        if imgui.Button("Camera"):
            self._aim()
        imgui.PushItemWidth(imgui.GetContentRegionAvail().x * 0.5)
        changed, place = imgui.Combo("Speed", SPEEDS.index(view.speed), _SPEEDS)
        if changed:
            player.ask(partial(player.set_speed, SPEEDS[place]))
        if view.num_envs > 1:
            changed, shown = imgui.SliderInt("Environment", view.shown, 0, view.num_envs - 1)
            if changed:
                player.ask(partial(player.show, shown))
        self._checkpoints(view)
        self._commands(view)
        imgui.PopItemWidth()
        imgui.Separator()
        imgui.TextUnformatted(f"episode {view.episodes}, {view.episode_s:.2f} s, reward {view.reward:.4g}")
        if view.message:
            imgui.TextWrapped(view.message)
        self._looks()
        imgui.End()
        ux.view_gizmo_gui(self.viewer.model, self.viewer.data, self.viewer.camera, self._ux, area)

    def _checkpoints(self, view: View) -> None:
        if not view.checkpoints:
            return
        player = self._player
        names = [f"{step}{' (newest)' if step == view.checkpoints[-1] else ''}" for step in view.checkpoints]
        there = view.checkpoint in view.checkpoints
        if imgui.BeginCombo("Checkpoint", str(view.checkpoint)):
            for step, name in zip(view.checkpoints, names, strict=True):
                if imgui.Selectable(name, there and step == view.checkpoint):
                    player.ask(partial(player.switch, step))
            imgui.EndCombo()
        changed, follow = imgui.Checkbox("Play new ones as they appear", view.follow)
        if changed:
            player.ask(partial(player.set_follow, follow))

    def _commands(self, view: View) -> None:
        for knob in view.knobs:
            held = knob.name in view.held
            changed, hold = imgui.Checkbox(f"##{knob.name}", held)
            if changed:
                start = min(max(0.0, knob.low), knob.high)
                self._player.ask(partial(self._player.hold, knob.name, start if hold else None))
            imgui.SetItemTooltip("hold it; else the task draws it")
            imgui.SameLine()
            moved, value = imgui.SliderFloat(knob.name, view.held.get(knob.name, 0.0), knob.low, knob.high)
            if moved:
                self._player.ask(partial(self._player.hold, knob.name, value))

    def _looks(self) -> None:
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

    def _aim(self) -> None:
        """Look as the task's `viewer` says."""
        camera, begin = self.viewer.camera, self._begin
        camera.type, camera.fixedcamid, camera.trackbodyid = int(mujoco.mjtCamera.mjCAMERA_FREE), -1, -1
        camera.lookat[:] = begin.lookat + self._places[self._shown]
        camera.distance, camera.azimuth, camera.elevation = begin.distance, begin.azimuth, begin.elevation
        self._ux.camera_index = ux.TUMBLE_CAMERA_IDX

    def _push(self) -> None:
        """A dragged body pushes on the simulation."""
        model, data, perturb = self.viewer.model, self.viewer.data, self.viewer.perturb
        if not perturb.active and not self._pushing:
            return
        data.xfrc_applied[:] = 0.0
        if perturb.active:
            mujoco.mjv_applyPerturbForce(model, data, perturb)
        self._pushing = bool(perturb.active)
        self._player.ask(partial(self._player.push, data.xfrc_applied.copy()))

    def _keys(self, view: View) -> None:
        if imgui.GetIO().WantCaptureKeyboard:
            return
        player, key = self._player, imgui.Key
        asked: dict[int, Callable[[], None]] = {
            key.Space: partial(player.pause, not view.paused),
            key.RightArrow: player.single_step,
            key.Backspace: player.reset,
            key.Minus: partial(player.faster, -1),
            key.Equal: partial(player.faster, 1),
            key.UpArrow: partial(player.show, view.shown + 1),
            key.DownArrow: partial(player.show, view.shown - 1),
            key.PageUp: partial(player.neighbour, 1),
            key.PageDown: partial(player.neighbour, -1),
        }
        for code, request in asked.items():
            if imgui.IsKeyChordPressed(code):
                player.ask(request)
                return
        flies = self._ux.camera_index == ux.FREE_CAMERA_IDX
        if not inputs.handle_camera_select_keyboard_events(self.viewer.model, self.viewer.camera, self._ux):
            inputs.handle_vis_options_keyboard_events(self.viewer.vis_options, flies)


KEYS = (
    "Space: pause, go on. Right: one step. Backspace: new episodes. - and =: speed. Up, Down: environment."
    " PageUp, PageDown: newer, older checkpoint. Escape: free camera. Double click, then Ctrl and drag: push a body."
)

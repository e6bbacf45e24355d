"""Markers of commands in pictures: their positions and colours, and pictures without them."""

from contextlib import nullcontext
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
import yaml
from support.worlds import CRITTER_TASK, build, critter, dump, run

from rlcli.errors import ConfigError
from rlcli.rl.action_functions import zero_policy
from rlcli.sim.markers import ACTUAL, COMMANDED, Arrow, Frame, Sphere
from rlcli.sim.rotations import heading, rotate
from rlcli.viewer import native
from rlcli.viewer.draw_markers import add_markers
from rlcli.viewer.env_grid import EnvGrid
from rlcli.viewer.offscreen import Renderer
from rlcli.viewer.playback import Playback
from rlcli.viewer.record_video import record_episode

VIEWER = {"eye": [-1.8, -1.0, 2.2], "lookat": [0.0, 0.0, 0.5], "width": 480, "height": 360}
VELOCITY = {"func": "uniform_velocity", "resampling_time_s": [9, 9], "lin_vel_x": [-1, 1], "ang_vel_z": [-1, 1]}
POSE = {"func": "uniform_pose", "resampling_time_s": [9, 9], "bodies": "torso", "x": [0.2, 0.4], "y": [-0.3, 0.3],
        "z": [0.3, 0.5], "pitch": [-1.0, 1.0]}  # fmt: skip
PLACE = {"func": "uniform_pose2d", "resampling_time_s": [9, 9], "x": [-1, 1], "y": [-1, 1]}
OWN = """
import torch
from rlcli.sim.markers import Arrow, Frame, Sphere

class Beacon:
    \"\"\"A ball at so high a place, and nothing in environment 0.\"\"\"

    def __init__(self, env, *, height: float):
        self.command, self.calls = torch.full((env.num_envs, 1), height), 0

    def resample(self, selection):
        pass

    def update(self):
        pass

    def markers(self):
        self.calls += 1
        center = torch.zeros(len(self.command), 3)
        center[:, 2] = self.command[:, 0]
        center[0] = torch.nan
        return [Sphere(center, (1.0, 0.0, 1.0, 1.0), 0.15)]

class Given(Beacon):
    \"\"\"Markers that a test puts there.\"\"\"

    def markers(self):
        return self.given
"""


@pytest.fixture(autouse=True)
def _headless(monkeypatch):
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


def commanded_env(folder, num_envs=2, *overrides, still=True, sensors=None, **commands):
    """Environment of critters with commands; unless `still`, they start at random positions and move."""
    task = yaml.safe_load(CRITTER_TASK) | {"commands": commands, "viewer": VIEWER}
    task["scene"]["sensors"] = sensors or {}
    if still:
        task["events"] = {}
    env = build(critter(folder, dump(task), terms_py=OWN), num_envs, *overrides)
    env.reset(seed=1)
    return env


def pictures(env, number=0):
    """Return a picture with markers, and one without."""
    with Renderer(env.engine.model, env.config.viewer) as renderer:
        return renderer.image(env, number).astype(int), renderer.draw(*env.world(number)).astype(int)


def pixel(env, place):
    """Return the column and row of a point of the world in the picture."""
    viewer = env.config.viewer
    eye, ahead = np.array(viewer.eye), np.subtract(viewer.lookat, viewer.eye)
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    away = np.asarray(place, dtype=float) - eye
    focal = viewer.height / 2 / np.tan(np.radians(env.engine.model.vis.global_.fovy) / 2)
    x, y = (away @ axis / (away @ ahead) for axis in (right, np.cross(right, ahead)))
    return np.array([viewer.width / 2 + focal * x, viewer.height / 2 - focal * y])


def coloured(seen, bare, color):
    """Return the columns and rows of added pixels of a colour. (n, 2)"""
    channel = int(np.argmax(color[:3]))
    rest = np.delete(seen, channel, axis=2).max(axis=2)
    rows, columns = np.nonzero((seen != bare).any(axis=2) & (seen[..., channel] - rest > 60))
    return np.stack([columns, rows], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1])
def test_reach_goal_is_drawn_at_its_position(number):
    env = build("reach", 2)
    env.reset(seed=3)
    seen, bare = pictures(env, number)
    position, quat = (value[number] for value in env.command_manager.get_term("ee_pose").pose_w)
    center = pixel(env, position)
    rows, columns = np.nonzero((seen != bare).any(axis=2))
    away = np.hypot(columns - center[0], rows - center[1])
    assert len(away) > 150
    assert away.max() < 40  # axes of 0.1 m
    ball = coloured(seen, bare, COMMANDED)
    assert (np.linalg.norm(ball - center, axis=1) < 6).sum() > 50
    for color, axis in zip(np.eye(3), torch.eye(3), strict=True):
        tip = pixel(env, position + 0.09 * rotate(quat, axis))
        assert np.linalg.norm(coloured(seen, bare, color) - tip, axis=1).min() < 2.0, color


@pytest.mark.slow
@pytest.mark.parametrize(("vx", "vy"), [(0.8, 0.0), (-0.8, 0.0), (0.0, 0.8), (0.5, -0.5)])
def test_green_arrow_is_commanded_blue_arrow_is_actual_velocity(tmp_path, vx, vy):
    above = "viewer.eye=[-0.05,0.0,3.5]"  # else an arrow's head may hide its tip
    env = commanded_env(tmp_path, 1, above, still=False, walk=VELOCITY)
    for name, value in {"vx": vx, "vy": vy, "wz": 0.0}.items():
        env.command_manager.hold(name, value)
    env.step(torch.zeros(1, 4))
    seen, bare = pictures(env)
    data = env.entities["robot"].data
    root = data.root_pos_w[0]
    asked = rotate(data.root_quat_w, torch.tensor([[vx, vy, 0.0]]))[0]
    actual = rotate(data.root_quat_w, data.root_lin_vel_b * torch.tensor([1.0, 1.0, 0.0]))[0]
    for color, velocity, height in ((COMMANDED, asked, 0.5), (ACTUAL, actual, 0.45)):
        start = root + torch.tensor([0.0, 0.0, height])
        begin, end = pixel(env, start), pixel(env, start + velocity)
        found = coloured(seen, bare, color)
        along = (found - begin) @ (end - begin) / np.linalg.norm(end - begin)
        assert along.max() == pytest.approx(np.linalg.norm(end - begin), abs=4.0)
        assert np.linalg.norm(found - end, axis=1).min() < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("wz", [0.7, -0.7])
def test_turn_rate_marker_position(tmp_path, wz):
    env = commanded_env(tmp_path, 1, still=False, walk=VELOCITY)
    for name, value in {"vx": 0.0, "vy": 0.0, "wz": wz}.items():
        env.command_manager.hold(name, value)
    env.step(torch.zeros(1, 4))
    still, turns = [marker for marker in env.markers() if marker.color == COMMANDED]
    assert torch.equal(still.start, still.end)
    data = env.entities["robot"].data
    ahead, aside = (rotate(data.root_quat_w, torch.tensor([way])) for way in ([0.5, 0.0, 0.0], [0.0, 0.5 * wz, 0.0]))
    torch.testing.assert_close(turns.start, still.start + ahead)
    torch.testing.assert_close(turns.end, turns.start + aside)
    seen, bare = pictures(env)
    assert len(coloured(seen, bare, COMMANDED)) > 20


def test_pose_command_is_sphere_with_arrow(tmp_path):
    env = commanded_env(tmp_path, 3, still=False, place=PLACE)
    run(env, 3, reset=False)
    ball, arrow = env.markers()
    term = env.command_manager.get_term("place")
    torch.testing.assert_close(ball.center, term._target[:, :3])
    way = arrow.end - arrow.start
    torch.testing.assert_close(torch.atan2(way[:, 1], way[:, 0]), term._target[:, 3])
    torch.testing.assert_close(way.norm(dim=1), torch.full((3,), 0.5))
    assert float((heading(env.entities["robot"].data.root_quat_w) - term._target[:, 3]).abs().min()) > 0.01


@pytest.mark.slow
@pytest.mark.parametrize(
    "commands",
    [
        {},
        {"nothing": {"func": "null_command", "resampling_time_s": [9, 9]}},
        {"stand": VELOCITY | {"lin_vel_x": [0, 0], "ang_vel_z": [0, 0]}},
        {"own": {"func": "beacon", "resampling_time_s": [9, 9], "height": 0.9}},
    ],
    ids=["no command", "a command without markers", "no velocity, asked or actual", "not finite"],
)
def test_no_markers_for_zero_commands(tmp_path, commands):
    env = commanded_env(tmp_path, 2, **commands)
    seen, bare = pictures(env)
    np.testing.assert_array_equal(seen, bare)
    assert bare.std() > 5


@pytest.mark.slow
def test_custom_command_markers_are_computed_only_for_pictures(tmp_path):
    env = commanded_env(tmp_path, 2, own={"func": "beacon", "resampling_time_s": [9, 9], "height": 0.9})
    term = env.command_manager.get_term("own")
    run(env, 3)
    assert term.calls == 0
    seen, bare = pictures(env, 1)
    assert term.calls == 1
    rows, columns = np.nonzero((seen != bare).any(axis=2))
    assert [columns.mean(), rows.mean()] == pytest.approx(pixel(env, [0.0, 0.0, 0.9]), abs=2.0)
    magenta = seen[rows, columns]
    assert (np.minimum(magenta[:, 0], magenta[:, 2]) - magenta[:, 1] > 60).mean() > 0.9


@pytest.mark.slow
def test_camera_sensors_do_not_render_markers(tmp_path):
    front = {"kind": "camera", "data": "rgb", "width": 64, "height": 48, "eye": [-2, 0, 0.9], "lookat": [0, 0, 0.9]}
    own = {"func": "beacon", "resampling_time_s": [9, 9], "height": 0.9}
    images = {}
    for name, commands in {"asked": {"own": own}, "alone": {}}.items():
        env = commanded_env(tmp_path / name, 2, sensors={"front": front}, **commands)
        seen, bare = pictures(env, 1)
        before = env.sensors["front"].image.clone()
        env.sensors["front"].update(0.0)
        pictures(env, 1)
        assert torch.equal(env.sensors["front"].image, before)
        images[name] = before, (seen != bare).any()
        env.close()
    assert images["asked"][1]
    assert not images["alone"][1]
    assert torch.equal(images["asked"][0], images["alone"][0])


@pytest.mark.slow
def test_rendering_does_not_change_simulation(tmp_path):
    commands = {"walk": VELOCITY, "pose": POSE, "place": PLACE}
    steps = {}
    for drawn in (False, True):
        env = commanded_env(tmp_path / str(drawn), 3, still=False, **commands)
        results = []
        with Renderer(env.engine.model, env.config.viewer, EnvGrid(env, 3)) if drawn else nullcontext() as renderer:
            for _ in range(20):
                if drawn:
                    renderer.image(env)
                results += run(env, 2, reset=False)
        state = env.state_dict()
        steps[drawn] = [*(value for result in results for value in (*result.obs.values(), result.reward)), state]
    states = [steps[drawn].pop() for drawn in (False, True)]
    assert all(torch.equal(one, other) for one, other in zip(*steps.values(), strict=True))
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())


def shapes(scene):
    """Return kind and position of all markers of a scene."""
    decor = [geom for geom in scene.geoms[: scene.ngeom] if geom.category == mujoco.mjtCatBit.mjCAT_DECOR]
    return [(int(geom.type), geom.pos.copy()) for geom in decor]


def test_grid_draws_markers_of_each_environment(tmp_path):
    env = commanded_env(tmp_path, 5, still=False, pose=POSE)
    scene = mujoco.MjvScene(env.engine.model, maxgeom=1000)
    env_grid = EnvGrid(env, 3)
    env_grid.add(scene, 3, mujoco.MjvOption())
    centers = env.command_manager.get_term("pose").pose_w[0][[3, 4, 0]].double().numpy() + env_grid.offsets()
    balls = [place for kind, place in shapes(scene) if kind == mujoco.mjtGeom.mjGEOM_SPHERE]
    np.testing.assert_allclose(balls, centers, atol=1e-5)
    assert len(shapes(scene)) == 3 * 4
    assert np.abs(env_grid.offsets()[1:]).max(axis=1).min() > 0.5


@pytest.mark.slow
def test_grid_picture_shows_all_markers(tmp_path):
    env = commanded_env(
        tmp_path, 4, "scene.env_spacing=2", own={"func": "given", "resampling_time_s": [9, 9], "height": 1.0}
    )
    env_grid, counts = EnvGrid(env, 4), {}
    env.command_manager.get_term("own").given = []
    with Renderer(env.engine.model, env.config.viewer, env_grid) as renderer:
        bare = renderer.image(env).astype(int)
        env.command_manager.get_term("own").given = [Sphere(torch.tensor([[0.0, 0.0, 1.0]] * 4), radius=0.1)]
        seen = renderer.image(env).astype(int)
    rows, columns = np.nonzero((seen != bare).any(axis=2))
    labels = np.zeros(len(rows), int)
    for index in range(len(rows)):  # each pixel to the first found within a ball's width of it
        near = np.hypot(rows[:index] - rows[index], columns[:index] - columns[index]) < 25
        labels[index] = labels[:index][near][0] if near.any() else labels[:index].max(initial=0) + 1
        counts[labels[index]] = counts.get(labels[index], 0) + 1
    assert len(counts) == 4
    assert min(counts.values()) > 20


def test_browser_gets_marker_copies(tmp_path):
    env = commanded_env(tmp_path, 2, pose=POSE)
    scene = mujoco.MjvScene(env.engine.model, maxgeom=1024)
    found = list(EnvGrid(env, 1).geoms(scene, 1, mujoco.MjvOption()))
    kinds = [int(geom.type) for geom in found]
    assert kinds.count(int(mujoco.mjtGeom.mjGEOM_SPHERE)) == 1
    assert len(kinds) == 4
    assert found[0].pos == pytest.approx(env.command_manager.get_term("pose").pose_w[0][1].numpy())
    assert found[0].rgba == pytest.approx(COMMANDED)
    assert {int(geom.objid) for geom in found} == {-1}  # of no body
    assert {geom.castshadow for geom in found} == {0}


def test_markers_and_commands_have_names_and_units(tmp_path):
    given = {"func": "given", "resampling_time_s": [9, 9], "height": 1.0}
    velocity = {"func": "uniform_velocity", "resampling_time_s": [9, 9], "lin_vel_x": [1, 1]}
    env = commanded_env(tmp_path, 2, velocity=velocity, own=given)
    env.command_manager.get_term("own").given = [Sphere(torch.zeros(2, 3))]
    labels = [marker.label for marker in env.markers()]
    parts = ("velocity", "yaw rate (arrow ahead)")
    assert labels == [f"{kind} {part}" for kind in ("commanded", "actual") for part in parts] + ["own"]
    knobs = env.command_manager.knobs()
    assert [knob.label for knob in knobs][:3] == ["vx [m/s]", "vy [m/s]", "wz [rad/s]"]
    assert env.command_manager.value(knobs[0], 1) == 1.0


def test_window_gets_markers(tmp_path):
    env = commanded_env(tmp_path, 2, pose=POSE)
    playback = Playback(env, zero_policy(env))
    model, _ = env.world(0)
    scene = mujoco.MjvScene(model, maxgeom=100)
    window = SimpleNamespace(
        lock=nullcontext, user_scn=scene, opt=mujoco.MjvOption(), set_texts=lambda *_: None, sync=lambda: None
    )
    for _ in range(2):  # anew in each frame, not more and more
        native._draw(window, playback, EnvGrid(env, 1), model, mujoco.MjData(model))
        assert len(shapes(scene)) == scene.ngeom == 4


@pytest.mark.slow
def test_video_shows_markers(tmp_path):
    from PIL import Image

    env = commanded_env(tmp_path, 1, pose=POSE)
    record_episode(env, zero_policy(env), tmp_path / "x.gif", longest_s=0.1)
    with Image.open(tmp_path / "x.gif") as image:
        last = np.asarray(image.convert("RGB")).astype(int)
    assert ((last[..., 1] - np.maximum(last[..., 0], last[..., 2])) > 60).sum() > 20


def test_markers_are_limited_by_scene_size(tmp_path):
    env = commanded_env(tmp_path, 4, pose=POSE)
    scene = mujoco.MjvScene(env.engine.model, maxgeom=6)
    add_markers(scene, env.markers(), range(4), np.zeros((4, 3)))
    assert scene.ngeom == 6


WRONG = {
    "returned a value of type dict; return Arrow, Sphere or Frame": lambda n: {},
    r"returned Sphere.center of shape \(3,\); return a tensor of shape \(4, 3\)": lambda n: Sphere(torch.zeros(3)),
    r"returned Arrow.end of type list; return a tensor of shape \(4, 3\)": lambda n: Arrow(
        torch.zeros(n, 3), [0, 0, 1]
    ),
    r"returned Frame.quat of shape \(4, 3\); return a tensor of shape \(4, 4\)": lambda n: Frame(
        torch.zeros(n, 3), torch.zeros(n, 3)
    ),
}


@pytest.mark.parametrize("message", WRONG)
def test_invalid_marker_error_names_term(tmp_path, message):
    env = commanded_env(tmp_path, 4, own={"func": "given", "resampling_time_s": [9, 9], "height": 1.0})
    env.command_manager.get_term("own").given = [WRONG[message](4)]
    with pytest.raises(ConfigError, match=f"commands.own: markers\\(\\) {message}"):
        env.markers()

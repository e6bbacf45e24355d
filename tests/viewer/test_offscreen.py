"""Pictures and video files, drawn without a display."""

import json
import os
import subprocess
import sys

import mujoco
import numpy as np
import pytest

from rlcli.config.load import resolve
from rlcli.config.schema import ViewerConfig
from rlcli.envs.make import make_env
from rlcli.errors import ConfigError, DependencyError, MachineError, UsageError, pip_install
from rlcli.registry import find_task
from rlcli.sim.gl import open_context
from rlcli.viewer.offscreen import Renderer, free_camera
from rlcli.viewer.video_writer import VideoWriter, check_video, gif_stride

PICTURES = [np.full((48, 64, 3), value, np.uint8) for value in (0, 80, 160, 240)]

# in a process of its own: imageio's reader leaves pipes open
READ = """
import json, sys, imageio.v2 as imageio
reader = imageio.get_reader(sys.argv[1])
print(json.dumps([reader.get_meta_data()["fps"], [float(frame.mean()) for frame in reader]]))
"""


@pytest.fixture(autouse=True)
def _headless(monkeypatch):
    for name in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


def test_free_camera_is_at_eye_and_looks_at_lookat():
    camera = free_camera(ViewerConfig(eye=(8.0, 0.0, 5.0), lookat=(0.0, 0.0, 2.0)))
    azimuth, elevation = np.radians(camera.azimuth), np.radians(camera.elevation)
    ahead = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    np.testing.assert_allclose(camera.lookat - camera.distance * np.array(ahead), [8.0, 0.0, 5.0], atol=1e-9)


@pytest.mark.slow
def test_picture_shows_moving_pole():
    env = make_env(resolve(find_task("cartpole"), overrides=["scene.num_envs=2"]))
    env.reset(seed=1)
    with Renderer(env.engine.model, env.config.viewer) as renderer:
        first = renderer.draw(*env.world(0))
        other = renderer.draw(*env.world(1))
        again = renderer.draw(*env.world(0))
    assert first.shape == (480, 640, 3)
    assert first.std() > 20
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    orange = (first[..., 0].astype(int) - first[..., 2] > 80).sum()
    blue = (first[200:280, :, 2].astype(int) - first[200:280, :, 0] > 60).sum()
    assert orange > 150  # the pole
    assert blue > 100  # the cart


@pytest.mark.slow
def test_camera_follows_entity():
    drawn = {}
    for follow in ("robot", None):
        overrides = ["scene.num_envs=1", f"viewer.follow={follow or 'null'}"]
        env = make_env(resolve(find_task("quadruped-flat"), overrides=overrides))
        env.reset(seed=1)
        model, data = env.world(0)
        with Renderer(model, env.config.viewer) as renderer:
            pictures = []
            for x in (0.0, 8.0):  # the ground's pattern repeats every metre
                data.qpos[0] = x
                mujoco.mj_forward(model, data)
                pictures.append(renderer.draw(model, data).astype(int))
        drawn[follow] = np.abs(pictures[0] - pictures[1]).mean()
        assert pictures[0].std() > 20
    assert drawn["robot"] < 1.0 < drawn[None]


@pytest.mark.slow
def test_light_follows_entity():
    env = make_env(resolve(find_task("ant-direct"), overrides=["scene.num_envs=1"]))
    env.reset(seed=1)
    model, data = env.world(0)
    pictures = []
    with Renderer(model, env.config.viewer) as renderer:
        for place in (0.0, 100.0):  # whole squares of the ground
            data.qpos[:2] = place
            mujoco.mj_forward(model, data)
            pictures.append(renderer.draw(model, data)[240:].astype(int))  # below the horizon
    assert (np.abs(pictures[0] - pictures[1]).max(axis=2) > 20).mean() < 0.01


def test_unknown_followed_entity_is_rejected():
    with pytest.raises(ConfigError, match=r"there is no entity 'rover' in the scene; entities: robot"):
        resolve(find_task("cartpole"), overrides=["viewer.follow=rover"])


def test_disabled_gl_is_machine_error(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disable")
    with pytest.raises(MachineError, match="rendering is disabled by MUJOCO_GL=disable"):
        open_context(64, 48)


def test_missing_gl_lists_backends_and_packages():
    code = (
        "import sys\nclass Hidden:\n    def find_spec(name, *_):\n"
        "        if name in ('mujoco.egl', 'mujoco.osmesa'): raise ImportError(name)\n"
        "sys.meta_path.insert(0, Hidden)\n"
        "from rlcli.errors import MachineError\nfrom rlcli.sim.gl import open_context\n"
        "try: open_context(64, 48)\nexcept MachineError as e: print(e.message, '|', e.hint)"
    )
    env = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True).stdout
    assert "tried egl" in done
    assert "osmesa" in done
    assert "apt install libegl1 libosmesa6" in done


@pytest.mark.slow
def test_mp4_has_all_frames_at_control_rate(tmp_path):
    file = tmp_path / "deep" / "x.mp4"
    with VideoWriter(file, 1 / 60) as writer:
        for picture in PICTURES:
            writer.add(picture)
    read = subprocess.run([sys.executable, "-c", READ, str(file)], capture_output=True, text=True)
    fps, means = json.loads(read.stdout)
    assert fps == 60
    assert means == pytest.approx([0, 80, 160, 240], abs=6)
    assert sorted(p.name for p in file.parent.iterdir()) == ["x.mp4"]


@pytest.mark.skipif(sys.platform != "linux", reason="limits of file size")
@pytest.mark.parametrize(("name", "limit"), [("x.mp4", 0), ("x.mp4", 4096), ("x.mp4", 40_000), ("x.gif", 4096)])
def test_video_that_the_disk_cuts_off_is_an_error(name, limit, tmp_path):
    import resource

    def write():
        with VideoWriter(tmp_path / name, 1 / 50) as writer:
            for picture in np.random.default_rng(1).integers(0, 256, (40, 48, 64, 3), np.uint8):
                writer.add(picture)

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        with pytest.raises(MachineError, match=f"cannot write .*{name}: File too large$") as caught:
            write()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "ulimit -f" in caught.value.hint
    assert not list(tmp_path.iterdir())


def test_two_processes_write_a_video_of_one_name(tmp_path):
    code = (
        "import sys, numpy as np; from pathlib import Path; from rlcli.viewer.video_writer import VideoWriter\n"
        "with VideoWriter(Path(sys.argv[1]), 1 / 50) as writer:\n"
        "    writer.add(np.zeros((48, 64, 3), np.uint8)); print('begun', flush=True); sys.stdin.read()\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "x.gif")]
    both = [subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    for process in both:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
    for process in both:
        process.communicate("")
        assert process.returncode == 0
    assert [file.name for file in tmp_path.iterdir()] == ["x.gif"]


@pytest.mark.parametrize(("period", "frames", "duration"), [(0.02, 4, 20), (0.05, 4, 50), (1 / 60, 2, 50)])
def test_gif_speed_is_right(tmp_path, period, frames, duration):
    from PIL import Image

    with VideoWriter(tmp_path / "x.gif", period) as writer:
        for picture in PICTURES:
            writer.add(picture)
    with Image.open(tmp_path / "x.gif") as image:
        assert image.n_frames == frames == writer.frames
        assert image.info["duration"] == duration


@pytest.mark.parametrize("rate", [10, 20, 24, 25, 30, 50, 60, 60.24, 100, 120, 200, 500])
def test_gif_stride_is_right_within_two_percent(rate):
    shown = gif_stride(1 / rate) / rate
    assert abs(round(100 * shown) / (100 * shown) - 1) < 0.02
    assert round(100 * shown) >= 2


def test_failed_video_leaves_no_file(tmp_path):
    def fail():
        with VideoWriter(tmp_path / "x.gif", 0.02) as writer:
            writer.add(PICTURES[0])
            raise RuntimeError("in the middle")

    with pytest.raises(RuntimeError):
        fail()
    assert list(tmp_path.iterdir()) == []


def test_old_video_stays_until_new_one_is_complete(tmp_path):
    (tmp_path / "x.gif").write_bytes(b"old")

    def fail():
        with VideoWriter(tmp_path / "x.gif", 0.02) as writer:
            writer.add(PICTURES[0])
            raise RuntimeError("in the middle")

    with pytest.raises(RuntimeError):
        fail()
    assert (tmp_path / "x.gif").read_bytes() == b"old"


@pytest.mark.parametrize("name", ["x.avi", "x", "x.mp4.txt", ".mp4"])
def test_other_suffix_is_usage_error(tmp_path, name):
    with pytest.raises(UsageError, match="is not a video file"):
        check_video(tmp_path / name)


def test_unwritable_folder_is_machine_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(MachineError, match="cannot write"):
        VideoWriter(tmp_path / "file" / "x.gif", 0.02)


def test_missing_ffmpeg_rejects_mp4_but_not_gif(monkeypatch, tmp_path):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(tmp_path / "nothing"))
    with pytest.raises(MachineError, match="IMAGEIO_FFMPEG_EXE is not a program") as caught:
        check_video(tmp_path / "x.mp4")
    assert ".gif" in caught.value.hint
    check_video(tmp_path / "x.gif")


def test_missing_ffmpeg_error_says_how_to_install(monkeypatch, tmp_path):
    import imageio_ffmpeg

    def fails():
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", fails)
    with pytest.raises(MachineError, match="needs the program ffmpeg, which was not found") as caught:
        check_video(tmp_path / "x.mp4")
    assert "apt install ffmpeg" in caught.value.hint


def test_missing_imageio_names_pip_command(monkeypatch, tmp_path):
    import importlib.util

    real = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n, *a: None if n.startswith("imageio") else real(n, *a))
    with pytest.raises(DependencyError) as caught:
        check_video(tmp_path / "x.mp4")
    assert caught.value.hint == pip_install("rlcli[video]")


def test_check_video_imports_nothing_heavy():
    code = (
        "import sys; from pathlib import Path\nfrom rlcli.viewer.video_writer import check_video\n"
        "check_video(Path('x.mp4')); print([m for m in ('torch', 'mujoco', 'numpy', 'imageio') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stderr

"""`play --video` of a balancing policy: one frame for each step, at the control rate, with an upright pole."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]

READ = """
import sys, imageio.v2 as imageio, numpy as np
reader = imageio.get_reader(sys.argv[1])
np.savez(sys.argv[2], frames=np.stack([frame for frame in reader]), fps=reader.get_meta_data()["fps"])
"""


def test_video_of_trained_policy_shows_upright_pole(cartpole_run, tmp_path):
    variables = {k: v for k, v in os.environ.items() if k not in ("MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY")}
    words = ["play", "--checkpoint", "latest", "--video", "x.mp4", "--json", "--runs-dir", cartpole_run.parent.parent]
    words += ["viewer.width=320", "viewer.height=240"]
    command = [sys.executable, "-m", "rlcli", *map(str, words)]
    done = subprocess.run(command, cwd=tmp_path, env=variables, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    subprocess.run([sys.executable, "-c", READ, tmp_path / "x.mp4", tmp_path / "x.npz"], check=True)
    with np.load(tmp_path / "x.npz") as read:
        frames, fps = read["frames"], float(read["fps"])
    assert len(frames) == document["frames"] == 300
    assert fps == pytest.approx(60.0, rel=1e-3)
    assert min(frame.std() for frame in frames) > 10
    for frame in frames[120:].astype(int):
        pole = (frame[..., 0] - frame[..., 2] > 80) & (frame[..., 0] > 120)
        rows, columns = np.nonzero(pole)
        assert len(rows) > 12
        assert np.ptp(rows) > 3 * np.ptp(columns)  # upright or hanging
        cart = (frame[..., 2] - frame[..., 0] > 60) & (frame[..., 1] < 120)
        assert rows.mean() < np.nonzero(cart[rows.min() :])[0].mean() + rows.min()  # above the cart

"""Wrong values of MUJOCO_GL and DISPLAY, and of names on the command line, have clear messages."""

import os
import subprocess
import sys

import pytest


def rlcli(folder, *words, **environment):
    return subprocess.run(
        [sys.executable, "-m", "rlcli", *words],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1", **environment},
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_invalid_mujoco_gl_lists_valid_values(tmp_path):
    done = rlcli(tmp_path, "eval", "cartpole", "--policy", "zero", "--episodes", "1", MUJOCO_GL="elg")
    assert done.returncode == 10
    assert "MUJOCO_GL=elg" in done.stderr
    assert "egl, osmesa, glfw or disable" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_unreachable_display_falls_back_to_other_backend(tmp_path):
    """Another backend draws, or the message lists the backends that were tried."""
    words = ("play", "cartpole", "--policy", "zero", "--num-envs", "1", "--video", "x.mp4")
    done = rlcli(tmp_path, *words, DISPLAY=":77", MUJOCO_GL="")
    assert done.returncode in (0, 10), done.stderr
    assert (tmp_path / "x.mp4").exists() == (done.returncode == 0)
    assert done.returncode == 0 or "tried glfw (no window can be opened on the display)" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("command", ["eval", "play", "export"])
def test_run_given_as_task_has_checkpoint_hint(tmp_path, command):
    assert rlcli(tmp_path, "train", "cartpole", "--num-envs", "4", "--max-iterations", "1").returncode == 0
    done = rlcli(tmp_path, command, "latest")
    assert done.returncode == 4
    assert "'latest' is a run, not a task" in done.stderr
    assert "hint: --checkpoint latest" in done.stderr


def test_did_you_mean_has_no_duplicates():
    from rlcli.errors import did_you_mean

    assert did_you_mean("body_mas", ["body_mass", "body_mass"]) == "did you mean 'body_mass'?"

"""Fixtures that run the command line in an empty folder, in a subprocess or in this process."""

import os
import subprocess
import sys

import pytest


@pytest.fixture
def here(tmp_path):
    folder = tmp_path / "here"
    folder.mkdir()
    return folder


@pytest.fixture
def rlcli(here, tmp_path):
    """Return a function that runs `rlcli ARGUMENTS` in a subprocess and returns the finished process."""

    def run(*arguments, stdout=subprocess.PIPE, **environment):
        env = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache"), **environment}
        command = [sys.executable, "-m", "rlcli", *arguments]
        return subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, text=True, cwd=here, env=env, timeout=120)

    return run


@pytest.fixture
def in_process(monkeypatch, here, capfd):
    """Return a function that runs `rlcli ARGUMENTS` in this process and returns (exit code, stdout, stderr)."""
    from rlcli.cli.app import main

    monkeypatch.chdir(here)

    def run(*arguments):
        capfd.readouterr()
        code = main(list(arguments))
        return (code, *capfd.readouterr())

    return run


MODEL = """\
<mujoco>
  <worldbody>
    <body name="cart">
      <joint name="slider" type="slide" axis="1 0 0"/>
      <geom type="box" size=".1 .1 .1" mass="1"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0"/>
        <geom type="capsule" size=".02 .3" mass=".1"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
TASK = """\
summary: a small task
decimation: 2
episode_length_s: 1.0
sim: {dt: 0.01}
scene:
  num_envs: 4
  entities:
    robot: {model: model.xml}
actions:
  push: {func: joint_effort, joints: [slider]}
observations:
  policy:
    pos: {func: joint_pos_rel}
rewards:
  alive: {func: is_alive, weight: 1.0}
agents:
  default: small
  small: {trainer: sb3, algorithm: ppo, max_iterations: 1}
"""


@pytest.fixture
def small(here):
    """Return a function that writes a small task, with edits of its YAML, and returns its folder."""

    def make(*edits, model=MODEL, **files):
        folder = here / "small"
        folder.mkdir(exist_ok=True)
        text = TASK
        for old, new in edits:
            assert old in text
            text = text.replace(old, new)
        (folder / "task.yaml").write_text(text)
        if model is not None:
            (folder / "model.xml").write_text(model)
        for name, content in files.items():
            (folder / f"{name}.py").write_text(content)
        return "./small"

    return make

"""Fixtures that run the command line, in process or as a process, in an empty working folder."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from rlcli.cli.app import main

MODEL = """
<mujoco><worldbody><body name="block">
  <joint name="slide" type="slide"/><geom type="box" size="0.3 0.3 0.3" mass="1" contype="0" conaffinity="0"/>
</body></worldbody></mujoco>
"""
COIN = """
summary: Half of the episodes fail at once, the others last a hundred steps and succeed.
decimation: 1
episode_length_s: 1.0
sim: {dt: 0.01, gravity: [0, 0, 0]}
scene: {num_envs: 32, entities: {robot: {model: model.xml}}}
params: {chance: 0.5}
success: {centred: {func: joint_error, joints: [slide], at_most: 0.1, hold_s: 0.5}}
agents:
  ppo: {trainer: sb3, algorithm: ppo, max_iterations: 2, n_steps: 8, num_minibatches: 2}
"""
COIN_TASK = """
import torch
from rlcli.config.schema import StrictModel
from rlcli.envs.direct import DirectTask


class Task(DirectTask):
    num_observations = 1
    num_actions = 1

    class Params(StrictModel):
        chance: float = 0.5

    def post_reset(self):
        self.fails = torch.zeros(self.num_envs, dtype=torch.bool)

    def reset_idx(self, env_ids):
        self.fails[env_ids] = self.draws(env_ids).uniform(0.0, 1.0, (1,))[:, 0] < self.params.chance

    def pre_physics_step(self, actions): ...

    def get_observations(self):
        self.obs_buf[:, 0] = self.fails

    def calculate_metrics(self):
        self.rew_buf[:] = 1.0

    def is_done(self):
        self.reset_buf[:] = self.fails.long()
"""


@pytest.fixture
def empty_folder(tmp_path, monkeypatch):
    """Change to an empty working folder; restore torch's threads afterwards."""
    monkeypatch.chdir(tmp_path)
    for name in ("RLCLI_RUNS_DIR", "MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def cli(capfd):
    """Return a function that runs a command in this process: exit code, stdout, stderr, and stdout as JSON."""

    def run(*arguments):
        capfd.readouterr()
        code = main([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        assert "Traceback" not in err, err
        return SimpleNamespace(code=code, out=out, err=err, json=json.loads(out) if "--json" in arguments else None)

    return run


@pytest.fixture
def start():
    """Return a function that starts a command as a separate process."""
    started = []

    def begin(*arguments, **settings):
        command = [sys.executable, "-m", "rlcli", *map(str, arguments)]
        settings = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, **settings}
        started.append(subprocess.Popen(command, **settings))
        return started[-1]

    yield begin
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture
def coin(tmp_path):
    """Return a task folder with a known success rate."""
    folder = tmp_path / "coin"
    folder.mkdir()
    for name, text in (("task.yaml", COIN), ("task.py", COIN_TASK), ("model.xml", MODEL)):
        (folder / name).write_text(text)
    return "./coin"


@pytest.fixture
def only_run():
    """Return a function that finds the only run folder under `runs/`."""

    def find(runs="runs"):
        (folder,) = Path(runs).glob("*/*")
        return folder

    return find


@pytest.fixture
def weights():
    """Return a function that reads the last policy file of a run."""

    def read(run):
        return sorted(Path(run).glob("checkpoints/*/policy.safetensors"))[-1].read_bytes()

    return read


@pytest.fixture
def environment():
    """Return a copy of the environment variables."""
    return dict(os.environ)

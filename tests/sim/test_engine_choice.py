"""Tests of the choice of the engine, and of the errors if an engine is not available."""

import importlib.util
import json
import os
import subprocess
import sys

import pytest
import torch

from rlcli.sim import contact_capacity as _placed

ROOT = os.path.dirname(os.path.dirname(os.path.dirname(_placed.__file__)))
no_gpu = pytest.mark.skipif(torch.cuda.is_available(), reason="the test needs a machine without a GPU")


def python(code, folder):
    """Run code in a new process, with this checkout first on its path."""
    path = os.pathsep.join([ROOT, os.path.join(ROOT, "tasks"), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, "RLCLI_RUNS_DIR": str(folder / "runs")}
    return subprocess.run([sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True)


RUN = """
import sys
from rlcli.cli.app import main
code = main({arguments!r})
import json
print(json.dumps([code, sorted(n for n in sys.modules if n.split(".")[0] in ("warp", "mujoco_warp"))]))
"""
SMALL = ["train", "cartpole", "--max-iterations", "1", "--num-envs", "8", "agent.n_steps=8", "--quiet"]

WITHOUT = """
import sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "mujoco_warp":
            raise ModuleNotFoundError("No module named 'mujoco_warp'", name="mujoco_warp")
sys.meta_path.insert(0, Absent())
"""


def test_gpu_engine_is_installed_for_tests():
    assert importlib.util.find_spec("mujoco_warp") is not None


def test_missing_warp_raises_dependency_error_with_pip_line(tmp_path):
    done = python(WITHOUT + RUN.format(arguments=[*SMALL, "sim.engine=warp"]), tmp_path)
    code, loaded = json.loads(done.stdout.splitlines()[-1])
    assert code == 7, done.stderr
    assert '"rlcli[gpu]"' in done.stderr
    assert "mujoco-warp" in done.stderr
    assert "Traceback" not in done.stderr
    assert "mujoco_warp" not in loaded


def test_training_on_cpu_runs_without_warp(tmp_path):
    done = python(WITHOUT + RUN.format(arguments=[*SMALL, "--device", "cpu"]), tmp_path)
    assert json.loads(done.stdout.splitlines()[-1])[0] == 0, done.stderr


@no_gpu
@pytest.mark.parametrize("device", ["cuda", "cuda:1"])
def test_missing_gpu_exits_with_8(tmp_path, device):
    done = python(RUN.format(arguments=[*SMALL, "--device", device]), tmp_path)
    assert json.loads(done.stdout.splitlines()[-1])[0] == 8, done.stderr
    assert "no CUDA device" in done.stderr
    assert "--device cpu" in done.stderr
    assert not (tmp_path / "runs").exists()


@no_gpu
def test_training_on_cpu_does_not_import_warp(tmp_path):
    done = python(RUN.format(arguments=SMALL), tmp_path)
    assert json.loads(done.stdout.splitlines()[-1]) == [0, []], done.stderr


def test_model_unsupported_by_warp_raises_config_error(tmp_path):
    folder = tmp_path / "odd"
    folder.mkdir()
    (folder / "model.xml").write_text(
        '<mujoco><option solver="PGS"/><worldbody><body name="block"><joint name="slide" type="slide"/>'
        '<geom size="0.3" contype="0" conaffinity="0"/></body></worldbody></mujoco>'
    )
    (folder / "task.yaml").write_text(
        """
decimation: 1
episode_length_s: 1.0
sim: {dt: 0.01, engine: warp}
scene: {num_envs: 8, entities: {robot: {model: model.xml}}}
actions: {push: {func: joint_effort}}
observations: {policy: {pos: {func: joint_pos}}}
rewards: {alive: {func: is_alive, weight: 1.0}}
terminations: {time_out: {func: time_out, time_out: true}}
agents: {ppo: {trainer: sb3, algorithm: ppo, max_iterations: 1, n_steps: 8, num_minibatches: 2}}
"""
    )
    done = python(RUN.format(arguments=["train", "./odd", "--quiet"]), tmp_path)
    assert json.loads(done.stdout.splitlines()[-1])[0] == 3, done.stderr
    assert "PGS" in done.stderr
    assert "--device cpu" in done.stderr

"""Tests of the exact resume of a task with state in Python, and of the warning where this is not possible."""

import json
from pathlib import Path

import pytest
from support.scheduled_task import MODEL, YAML

from rlcli.cli.app import main
from rlcli.runs.metric_rows import read_rows

DIRECT = """
import itertools, random
import torch
from rlcli.envs.direct import DirectTask


class Curriculum:
    def __init__(self):
        self.level, self.seen = 0.0, []


class Task(DirectTask):
    num_observations = 2
    num_actions = 1

    def post_reset(self):
        self.phase, self.curriculum, self.tables = 0.0, Curriculum(), {"sum": torch.zeros(self.num_envs)}
        self.dice, self.noise = random.Random(4), torch.Generator().manual_seed(5)
        self.mean = torch.tensor(0.0)
        # MORE

    def pre_physics_step(self, actions):
        self.phase += 0.1
        self.mean += actions.mean()
        self.tables["sum"] += actions[:, 0]
        self.curriculum.level += self.dice.random()
        self.curriculum.seen.append(round(self.phase, 3))

    def get_observations(self):
        self.obs_buf[:, 0] = self.progress_buf
        self.obs_buf[:, 1] = torch.rand(self.num_envs, generator=self.noise) * 0.0 + self.phase % 1.0

    def calculate_metrics(self):
        self.rew_buf[:] = self.phase + self.mean + self.tables["sum"] + self.curriculum.level
        self.rew_buf += len(self.curriculum.seen) + torch.rand((), generator=self.noise)

    def is_done(self):
        self.reset_buf[:] = 0
"""
TERMS = '''
import torch


class drift:
    """(num_envs,)"""

    def __init__(self, env):
        self.env, self.calls, self.total = env, 0, torch.zeros(())

    def __call__(self):
        self.calls += 1
        self.total += 0.5
        return torch.full((self.env.num_envs,), 0.01 * self.calls) + self.total
'''
MANAGED = """
summary: A reward with state.
decimation: 1
episode_length_s: 0.03
sim: {dt: 0.01}
scene: {num_envs: 4, entities: {robot: {model: model.xml}}}
actions: {push: {func: joint_effort}}
observations: {policy: {pos: {func: joint_pos_rel}}}
rewards: {drift: {func: drift, weight: 1.0}}
terminations: {time_out: {func: time_out, time_out: true}}
agents:
  ppo: {trainer: sb3, algorithm: ppo, max_iterations: 2, n_steps: 8, num_minibatches: 2}
"""


@pytest.fixture
def task(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def make(kind, more=""):
        folder = Path("memories")
        folder.mkdir()
        (folder / "model.xml").write_text(MODEL)
        if kind != "managed":
            code = DIRECT.replace("# MORE", more)
            if kind == "direct with boolean flags":
                code = code.replace("self.reset_buf[:] = 0", "self.reset_buf = self.obs_buf[:, 1] > 0.85")
            if kind == "direct with other types":
                code = code.replace("self.rew_buf += ", "self.rew_buf = self.rew_buf.double() + ")
                code = code.replace("self.mean +=", "self.progress_buf = self.progress_buf.int()\n        self.mean +=")
            (folder / "task.yaml").write_text(YAML)
            (folder / "task.py").write_text(code)
        else:
            (folder / "task.yaml").write_text(MANAGED)
            (folder / "terms.py").write_text(TERMS)
        return "./memories"

    return make


def train(*words):
    assert main(["train", *words, "--logger", "none", "-q"]) == 0


def rows(run):
    kept = [{k: v for k, v in row.items() if not k.startswith("Perf/")} for row in read_rows(run / "metrics.jsonl")]
    return kept, sorted(run.glob("checkpoints/*/policy.safetensors"))[-1].read_bytes()


@pytest.mark.parametrize("kind", ["direct", "direct with boolean flags", "direct with other types", "managed"])
def test_python_state_of_task_is_resumed_exactly(task, kind, capsys):
    folder = task(kind)
    train(folder, "--name", "whole", "--max-iterations", "6")
    train(folder, "--name", "cut", "--max-iterations", "3")
    (whole,), (cut,) = Path("runs").glob("*/*-whole"), Path("runs").glob("*/*-cut")
    train("--resume", str(cut), "--max-iterations", "6")
    assert rows(cut) == rows(whole)
    assert json.loads((cut / "run.json").read_text())["resumes_exactly"]
    assert "may differ" not in capsys.readouterr().err


def test_run_warns_of_state_that_no_checkpoint_can_store(task, capsys):
    train(task("direct", "self.order = itertools.cycle([1, 2, 3])"), "--max-iterations", "1")
    assert (
        "a resumed run may differ from a run without interruption, because no checkpoint can store Task.order (cycle);"
        " keep the state of the task in numbers, containers, tensors or random generators" in capsys.readouterr().err
    )
    (run,) = Path("runs").glob("*/*")
    assert not json.loads((run / "run.json").read_text())["resumes_exactly"]

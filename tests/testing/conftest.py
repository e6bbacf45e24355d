"""Small task folders: a pendulum in both workflows, correct until a test plants a defect in it."""

import copy
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
import yaml

torch.set_num_threads(1)

PENDULUM = """<mujoco model="pendulum">
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="hinge" type="hinge" axis="0 1 0" damping="0.05"/>
      <geom name="arm" type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""

MANAGED = yaml.safe_load("""
decimation: 2
episode_length_s: 2.0
sim: {dt: 0.01}
scene:
  num_envs: 64
  entities: {robot: {model: pendulum.xml, joints: {hinge: {effort_limit: 3.0}}}}
actions:
  torque: {func: joint_effort, joints: [hinge], scale: 3.0}
observations:
  policy: {angle: {func: joint_pos}, rate: {func: joint_vel, scale: 0.1}}
events:
  start: {func: reset_joints_by_offset, mode: reset, position: [-0.5, 0.5]}
rewards:
  upright: {func: joint_pos_target_l2, weight: -1.0, target: 0.0}
terminations:
  time_out: {func: time_out, time_out: true}
""")

DIRECT = yaml.safe_load("""
decimation: 2
episode_length_s: 2.0
sim: {dt: 0.01}
scene:
  num_envs: 64
  entities: {robot: {model: pendulum.xml}}
""")

TERMS = """from __future__ import annotations

import math

import torch
from torch import Tensor

from rlcli.task import Entity, Joints
"""

TASK = """from __future__ import annotations

import torch
from torch import Tensor

from rlcli.config.schema import StrictModel
from rlcli.envs.articulation import ArticulationView
from rlcli.envs.direct import DirectTask


class Task(DirectTask):
    num_observations = 2
    num_actions = 1

    class Params(StrictModel):
        max_effort: float = 3.0

    def set_up_scene(self, scene):
        self.arms = scene.add(ArticulationView("robot"))

    def reset_idx(self, env_ids):
        angle = self.draws(env_ids).uniform(-0.5, 0.5, (1,))
        self.arms.set_joint_positions(angle, indices=env_ids)

    def pre_physics_step(self, actions):
        self.arms.set_joint_efforts(self.params.max_effort * actions)

    def get_observations(self):
        self.obs_buf[:, 0] = self.arms.get_joint_positions()[:, 0]
        self.obs_buf[:, 1] = self.arms.get_joint_velocities()[:, 0]

    def calculate_metrics(self):
        self.rew_buf[:] = 1.0 - self.obs_buf[:, 0].square()

    def is_done(self):
        self.reset_buf[:] = self.obs_buf[:, 0].abs() > 3.0
"""


@dataclass
class Folder:
    """Task folder that `write` writes; `replace` edits the code of the direct task."""

    path: Path
    config: dict
    xml: str = PENDULUM
    terms: str = ""
    task: str = ""

    def replace(self, old, new):
        assert old in self.task
        self.task = self.task.replace(old, new)
        return self

    def write(self):
        self.path.mkdir(exist_ok=True)
        (self.path / "task.yaml").write_text(yaml.safe_dump(self.config, sort_keys=False))
        (self.path / "pendulum.xml").write_text(self.xml)
        if self.terms:
            (self.path / "terms.py").write_text(TERMS + self.terms)
        if self.task:
            (self.path / "task.py").write_text(self.task)
        return self.path


@pytest.fixture
def managed(tmp_path):
    return Folder(tmp_path / "pendulum", copy.deepcopy(MANAGED))


@pytest.fixture
def direct(tmp_path):
    return Folder(tmp_path / "pendulum", copy.deepcopy(DIRECT), task=TASK)

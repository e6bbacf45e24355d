"""Files of a task whose episodes end at fixed steps."""

from pathlib import Path

import pytest

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task

MODEL = """
<mujoco><worldbody><body name="block">
  <joint name="slide" type="slide"/><geom size="0.1" mass="1"/>
</body></worldbody></mujoco>
"""
YAML = """
summary: Episodes that end on schedule.
decimation: 1
episode_length_s: 0.03
sim: {dt: 0.01}
scene: {num_envs: 4, entities: {robot: {model: model.xml}}}
agents:
  ppo: {trainer: sb3, algorithm: ppo, max_iterations: 2, n_steps: 8, num_minibatches: 2}
"""
TASK = '''
"""Env 0 terminates at step 2, env 1 is truncated at step 3, env 2 both at step 3, env 3 terminates at step 1."""
import torch
from rlcli.envs.direct import DirectTask

class Task(DirectTask):
    num_observations = 2
    num_actions = 1
    def pre_physics_step(self, actions): self.last_actions = actions.clone()
    def get_observations(self):
        self.obs_buf[:, 0] = self.progress_buf
        self.obs_buf[:, 1] = torch.arange(self.num_envs)
    def calculate_metrics(self): self.rew_buf[:] = 10.0 + self.progress_buf
    def is_done(self):
        ends = torch.tensor([2, 99, 3, 1]).repeat(self.num_envs)[: self.num_envs]
        self.reset_buf[:] = (self.progress_buf >= ends).long()
'''


@pytest.fixture
def scheduled(tmp_path: Path) -> str:
    """Write a task folder whose episodes end at fixed steps."""
    folder = tmp_path / "scheduled"
    folder.mkdir()
    for name, text in (("task.yaml", YAML), ("task.py", TASK), ("model.xml", MODEL)):
        (folder / name).write_text(text)
    return str(folder)


@pytest.fixture
def make():
    """Return make(task, *overrides) -> (environment, agent configuration)."""

    def build(task: str, *overrides: str, seed: int = 3):
        resolved = resolve(find_task(task), overrides=overrides)
        return make_env(resolved, seed=seed), resolved.agent

    return build

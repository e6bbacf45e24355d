"""Runs to export, trained once a module; tasks whose commands are worth a look."""

from pathlib import Path

import pytest
import torch

from rlcli.cli.app import main
from rlcli.rl.run import find_checkpoint

ARM = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" type="hinge" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
      <body name="lower" pos="0.3 0 0">
        <joint name="elbow" type="hinge" axis="0 1 0" ref="0.25"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
        <body name="hand" pos="0.3 0 0">
          <joint name="wrist" type="hinge" axis="0 1 0" actuatorfrcrange="-2 2"/>
          <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.02"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="m" joint="shoulder" gear="-3" ctrlrange="-1 2" forcerange="-1.5 1.5"/>
    <position name="p" joint="elbow" kp="5" ctrlrange="-0.5 0.75"/>
    <motor name="w" joint="wrist"/>
  </actuator>
</mujoco>
"""
YAML = """
summary: An arm whose every command is bounded in another way.
decimation: 1
episode_length_s: 0.2
sim: {dt: 0.01}
scene: {num_envs: 8, entities: {robot: {model: arm.xml}}}
actions:
  wrist: {func: joint_effort, joints: [wrist], scale: 4.0, offset: 0.5, clip: [-3.0, 3.0]}
  elbow: {func: joint_position, joints: [elbow], scale: 0.6, offset: 0.1}
  shoulder: {func: joint_effort, joints: [shoulder], scale: 10.0}
observations:
  policy:
    rates: {func: joint_vel, scale: [0.1, 0.2, 0.3], clip: [-5.0, 5.0]}
    angle: {func: joint_pos, joints: [elbow], scale: 2.0}
events:
  reset: {func: reset_joints_by_offset, mode: reset, position: [-0.2, 0.2]}
rewards:
  calm: {func: joint_vel_l1, weight: -1.0}
terminations:
  time_out: {func: time_out, time_out: true}
agents:
  ppo:
    {trainer: sb3, algorithm: ppo, max_iterations: 1, n_steps: 4, num_minibatches: 1, action_bound: 0.8,
     torch_threads: 1, policy: {hidden: [8], activation: tanh}}
"""
SHORT = ("--num-envs", "8", "--max-iterations", "2", "--logger", "none", "-q")


@pytest.fixture(autouse=True)
def _one_torch_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def runs(tmp_path_factory) -> Path:
    """A runs folder with a short run of each built-in cartpole and of the arm."""
    folder = tmp_path_factory.mktemp("trained")
    arm = folder / "arm"
    arm.mkdir()
    (arm / "task.yaml").write_text(YAML)
    (arm / "arm.xml").write_text(ARM)
    for task in ("cartpole", "cartpole-direct", str(arm)):
        assert main(["train", task, *SHORT, "--runs-dir", str(folder / "runs")]) == 0
    return folder / "runs"


@pytest.fixture
def newest(runs):
    """Task -> the folder of the newest checkpoint of its run."""
    return lambda task: find_checkpoint("latest", runs, task)[1]

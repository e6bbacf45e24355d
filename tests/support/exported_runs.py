"""Runs to export, trained once per module, and tasks whose commands are checked."""

from pathlib import Path

import pytest

from rlcli.cli.app import main
from rlcli.runs.run_ref import find_checkpoint

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
SAC = """
agents:
  sac:
    {trainer: sb3, algorithm: sac, max_iterations: 4, train_freq: 4, learning_starts: 64, gradient_steps: 2,
     batch_size: 32, buffer_size: 1000, normalize_observations: NORMALIZE, torch_threads: 1,
     policy: {hidden: [16, 16], activation: relu}}
"""
SHORT = ("--num-envs", "32", "--max-iterations", "4", "--logger", "none", "-q")


@pytest.fixture(scope="session")
def runs(tmp_path_factory) -> Path:
    """Return a runs folder with short runs: PPO and SAC of each cartpole, one normalised SAC, and the arm."""
    folder = tmp_path_factory.mktemp("trained")
    arm = folder / "arm"
    arm.mkdir()
    (arm / "task.yaml").write_text(YAML)
    (arm / "arm.xml").write_text(ARM)
    to = ("--runs-dir", str(folder / "runs"))
    for task, normalize in (("cartpole", "true"), ("cartpole-direct", "false")):
        config = folder / f"{task}.yaml"
        config.write_text(SAC.replace("NORMALIZE", normalize))
        chosen = ("--config", str(config), "--agent", "sac", "--name", "sac")
        assert main(["train", task, *chosen, *SHORT, *to]) == 0
        assert main(["train", task, *SHORT, *to]) == 0
    assert main(["train", str(arm), *SHORT, *to]) == 0
    return folder / "runs"


@pytest.fixture
def newest(runs):
    """Return a function: task, or task and `sac` -> folder of the newest checkpoint of its run."""

    def find(label):
        task, _, name = label.partition(" ")
        run = max(folder for folder in (runs / task).iterdir() if folder.name.endswith("-sac") == (name == "sac"))
        return find_checkpoint(str(run), runs)[1]

    return find

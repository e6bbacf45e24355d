"""Small real models and tasks for the tests, and functions that build environments of them."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import yaml
from torch import Tensor

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.envs.step_result import StepResult
from rlcli.envs.vec_env import VecEnv
from rlcli.registry import find_task

torch.set_num_threads(1)

ENGINES = ("batch", pytest.param("warp", marks=pytest.mark.warp))
"""Names of the engines, for tests that run on each."""

CRITTER = """
<mujoco model="critter">
  <compiler angle="degree" autolimits="true"/>
  <default><geom friction="0.8 0.01 0.001"/><joint damping="0.2" armature="0.01"/></default>
  <worldbody>
    <body name="torso" pos="0 0 0.35">
      <freejoint name="root"/>
      <geom type="box" size="0.2 0.12 0.05" mass="3"/>
      <site name="imu" pos="0.05 0 0"/>
      <body name="leg_fl" pos="0.18 0.14 0"><joint name="hip_fl" axis="0 1 0" range="-60 60"/>
        <geom type="capsule" size="0.025" fromto="0 0 0 0.02 0 -0.25" mass="0.3"/></body>
      <body name="leg_fr" pos="0.18 -0.14 0"><joint name="hip_fr" axis="0 1 0" range="-60 60"/>
        <geom type="capsule" size="0.025" fromto="0 0 0 0.02 0 -0.25" mass="0.3"/></body>
      <body name="leg_bl" pos="-0.18 0.14 0"><joint name="hip_bl" axis="0 1 0" range="-60 60"/>
        <geom type="capsule" size="0.025" fromto="0 0 0 -0.02 0 -0.25" mass="0.3"/></body>
      <body name="leg_br" pos="-0.18 -0.14 0"><joint name="hip_br" axis="0 1 0" range="-60 60"/>
        <geom type="capsule" size="0.025" fromto="0 0 0 -0.02 0 -0.25" mass="0.3"/></body>
    </body>
  </worldbody>
  <sensor><accelerometer name="acc" site="imu"/><gyro name="gyro" site="imu"/></sensor>
</mujoco>
"""

CRITTER_TASK = """
decimation: 4
episode_length_s: 0.6
sim: {dt: 0.005}
scene:
  num_envs: 4
  entities:
    robot:
      model: critter.xml
      joints: {".*": {kp: 20.0, kv: 0.5, effort_limit: 8.0}}
      init: {joint_pos: {"hip_.l": 0.1, "hip_.r": -0.1}}
actions:
  legs: {func: joint_position, joints: [hip_br, hip_fl, hip_bl, hip_fr], scale: 0.5}
observations:
  policy:
    height: {func: base_pos_z}
    lin: {func: base_lin_vel}
    ang: {func: base_ang_vel, scale: 0.25}
    gravity: {func: projected_gravity}
    pos: {func: joint_pos_rel}
    vel: {func: joint_vel_rel, joints: [hip_br, hip_fl, hip_bl, hip_fr], scale: 0.05, clip: [-100.0, 100.0]}
    action: {func: last_action}
  critic:
    raw_pos: {func: joint_pos}
    raw_vel: {func: joint_vel}
events:
  root:
    func: reset_root_state_uniform
    mode: reset
    x: [-0.5, 0.5]
    y: [-0.5, 0.5]
    z: [0.0, 0.05]
    roll: [-0.2, 0.2]
    pitch: [-0.2, 0.2]
    yaw: [-3.0, 3.0]
    linear_velocity: [[-0.5, 0.5], [-0.5, 0.5], [-0.2, 0.2]]
    angular_velocity: [[-0.5, 0.5], [-0.5, 0.5], [-0.5, 0.5]]
  joints: {func: reset_joints_by_scale, mode: reset, position: [0.5, 1.5], velocity: [0.0, 0.0]}
  push:
    func: push_by_setting_velocity
    mode: interval
    interval_range_s: [0.1, 0.3]
    linear_velocity: [[-1.0, 1.0], [-1.0, 1.0], [0.0, 0.0]]
    angular_velocity: [[-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]]
  shove:
    func: apply_external_force_torque
    mode: interval
    interval_range_s: [0.2, 0.4]
    bodies: [torso]
    force: [-5.0, 5.0]
rewards:
  alive: {func: is_alive, weight: 1.0}
  fell: {func: is_terminated, weight: -5.0}
  progress: {func: progress_reward, weight: 1.0, target: [100.0, 0.0, 0.0]}
  heading: {func: move_to_target_bonus, weight: 0.5, threshold: 0.8, target: [100.0, 0.0, 0.0]}
  upright: {func: upright_posture_bonus, weight: 0.1, threshold: 0.93}
  z: {func: lin_vel_z_l2, weight: -2.0}
  xy: {func: ang_vel_xy_l2, weight: -0.05}
  flat: {func: flat_orientation_l2, weight: -1.0}
  acc: {func: joint_acc_l2, weight: -1.0e-6}
  torque: {func: joint_torques_l2, weight: -1.0e-3}
  vel: {func: joint_vel_l2, weight: -1.0e-3, joints: [hip_br, hip_fl, hip_bl]}
  speed: {func: joint_vel_l1, weight: -1.0e-3}
  rate: {func: action_rate_l2, weight: -0.01}
  size: {func: action_l2, weight: -0.01}
  limits: {func: joint_pos_limits, weight: -1.0}
  ratio: {func: joint_pos_limits_penalty_ratio, weight: -0.1, threshold: 0.5}
  power: {func: power_consumption, weight: -0.01, joints: [hip_br, hip_fl, hip_bl, hip_fr]}
terminations:
  time_out: {func: time_out, time_out: true}
  tilt: {func: bad_orientation, limit_angle: 0.6}
  low: {func: root_height_below_minimum, minimum_height: 0.12}
"""

PENDULUM = """
<mujoco model="pendulum">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="base"><geom size="0.05" mass="1" contype="0" conaffinity="0"/>
      <body name="arm"><joint name="swing" axis="0 1 0"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.5" mass="1" contype="0" conaffinity="0"/></body>
    </body>
  </worldbody>
</mujoco>
"""

PENDULUM_TASK = """
decimation: 2
episode_length_s: 0.2
sim: {dt: 0.01}
scene: {num_envs: 3, ground: null, entities: {robot: {model: pendulum.xml}}}
actions: {torque: {func: joint_effort}}
observations: {policy: {pos: {func: joint_pos}, vel: {func: joint_vel}}}
rewards:
  alive: {func: is_alive, weight: 1.0}
  terminating: {func: is_terminated, weight: -10.0}
terminations: {time_out: {func: time_out, time_out: true}}
"""


def write(folder: Path, task: str, **files: str) -> Path:
    """Write a task folder; `model_xml="..."` becomes model.xml, `terms_py` becomes terms.py."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "task.yaml").write_text(task)
    for name, text in files.items():
        stem, _, suffix = name.rpartition("_")
        (folder / f"{stem}.{suffix}").write_text(text)
    return folder


def critter(folder: Path, task: str = CRITTER_TASK, **files: str) -> Path:
    return write(folder / "critter", task, critter_xml=CRITTER, **files)


def pendulum(folder: Path, task: str = PENDULUM_TASK, **files: str) -> Path:
    return write(folder / "pendulum", task, pendulum_xml=PENDULUM, **files)


def edited(task: str, **changes: object) -> str:
    """Return a YAML document with replaced top-level keys; dictionaries are merged one level deep."""
    data = yaml.safe_load(task)
    for key, value in changes.items():
        data[key] = {**data[key], **value} if isinstance(value, dict) and isinstance(data.get(key), dict) else value
    return dump(data)


def dump(data: object) -> str:
    """Return YAML without anchors."""
    dumper = type("Dumper", (yaml.SafeDumper,), {"ignore_aliases": lambda *_: True})
    return yaml.dump(data, Dumper=dumper, sort_keys=False)


def build(task: Path | str, num_envs: int | None = None, *overrides: str, seed: int = 42) -> VecEnv:
    sizes = [] if num_envs is None else [f"scene.num_envs={num_envs}"]
    return make_env(resolve(find_task(str(task)), overrides=[*sizes, *overrides]), seed=seed)


def actions(steps: int, num_envs: int, size: int, seed: int = 0) -> list[Tensor]:
    """Return actions; those of environment i do not depend on the number of environments."""
    rows = [
        torch.rand(steps, size, generator=torch.Generator().manual_seed(1000 * seed + env)) * 2 - 1
        for env in range(num_envs)
    ]
    return list(torch.stack(rows, dim=1))


def clone(result: StepResult) -> StepResult:
    return StepResult(
        {k: v.clone() for k, v in result.obs.items()},
        result.reward.clone(),
        result.terminated.clone(),
        result.truncated.clone(),
        None if result.final_obs is None else {k: v.clone() for k, v in result.final_obs.items()},
        result.episodes,
    )


def run(env: VecEnv, steps: int, seed: int = 0, reset: bool = True) -> list[StepResult]:
    if reset:
        env.reset()
    return [clone(env.step(a)) for a in actions(steps, env.num_envs, env.layout.action_size, seed)]


def results_of_env(results: list[StepResult], env: int) -> list[Tensor]:
    """Return all results of one environment, for a comparison bit by bit."""
    return [
        torch.cat([*(v[env] for v in r.obs.values()), r.reward[env : env + 1], r.terminated[env : env + 1].float(),
                   r.truncated[env : env + 1].float()])
        for r in results
    ]  # fmt: skip


def same(left: list[Tensor], right: list[Tensor]) -> bool:
    return len(left) == len(right) and all(torch.equal(a, b) for a, b in zip(left, right, strict=True))

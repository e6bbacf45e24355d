"""How much of a step a manager-based task spends outside physics: `python benchmarks/humanoid.py`.

A humanoid of 29 hinges that follows a velocity: 12 rewards, 3 observation groups with noise and history, 5 events.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path

import torch
import yaml
from machine import describe

from rlcli.config.load import resolve
from rlcli.envs.vec_env import VecEnv, make_env
from rlcli.registry import find_task


def limb(name: str, at: str, joints: list[tuple[str, str, str]], length: float, mass: float, end: str = "") -> str:
    """A chain of a link a joint (name, axis, range in degrees), the last one of them long."""
    text, closing = "", ""
    for number, (joint, axis, limits) in enumerate(joints):
        last = number == len(joints) - 1
        place = at if number == 0 else f"0 0 {-length if number == 3 else 0}"
        size = length if number in (2, len(joints) - 1) else 0.02
        text += (
            f'<body name="{name}_{joint}" pos="{place}"><joint name="{name}_{joint}" axis="{axis}" range="{limits}"/>'
            f'<geom type="capsule" size="0.03" fromto="0 0 0 0 0 {-size}" mass="{mass / len(joints)}" contype="0"/>'
        )
        text += end if last else ""
        closing += "</body>"
    return text + closing


LEG = [("yaw", "0 0 1", "-60 60"), ("roll", "1 0 0", "-30 30"), ("pitch", "0 1 0", "-120 45"),
       ("knee", "0 1 0", "0 140"), ("ankle_pitch", "0 1 0", "-50 40"), ("ankle_roll", "1 0 0", "-20 20")]  # fmt: skip
ARM = [("shoulder_pitch", "0 1 0", "-170 150"), ("shoulder_roll", "1 0 0", "-90 90"), ("shoulder_yaw", "0 0 1", "-90 90"),
       ("elbow", "0 1 0", "-120 10"), ("wrist_roll", "1 0 0", "-90 90"), ("wrist_pitch", "0 1 0", "-80 80"),
       ("wrist_yaw", "0 0 1", "-80 80")]  # fmt: skip
WAIST = [("yaw", "0 0 1", "-80 80"), ("roll", "1 0 0", "-30 30"), ("pitch", "0 1 0", "-30 30")]
FOOT = '<geom name="{0}_foot" type="box" size="0.09 0.04 0.015" pos="0.03 0 -0.035" mass="0.4"/>'


def humanoid() -> str:
    """MJCF of the robot."""
    legs = "".join(
        limb(side, f"0 {y} -0.08", LEG, 0.33, 6.0, FOOT.format(side)) for side, y in (("left", 0.1), ("right", -0.1))
    )
    arms = "".join(limb(f"{side}_arm", f"0 {y} 0.3", ARM, 0.2, 2.5) for side, y in (("left", 0.2), ("right", -0.2)))
    torso = '<geom type="box" size="0.08 0.12 0.18" pos="0 0 0.18" mass="12"/>' + arms
    return f"""
<mujoco model="humanoid29">
  <compiler angle="degree" autolimits="true"/>
  <option solver="Newton" iterations="10" ls_iterations="20"/>
  <default><joint damping="1" armature="0.02" frictionloss="0.1"/><geom friction="0.8 0.005 0.0001"/></default>
  <worldbody><body name="pelvis" pos="0 0 0.82"><freejoint name="root"/>
    <geom type="box" size="0.08 0.1 0.06" mass="5"/><site name="imu"/>{legs}{limb("waist", "0 0 0.08", WAIST, 0.02, 1.5, torso)}
  </body></worldbody>
  <sensor><gyro name="gyro" site="imu"/><velocimeter name="velocity" site="imu"/></sensor>
</mujoco>
"""


TASK = """
summary: A 29-joint humanoid that follows a velocity.
decimation: 4
episode_length_s: 20.0
sim: {dt: 0.005, integrator: implicitfast}
scene:
  num_envs: 1024
  sensors:
    feet: {kind: contact, entity: robot, bodies: [left_ankle_roll, right_ankle_roll], against: ground}
  entities:
    robot:
      model: humanoid.xml
      soft_joint_pos_limit_factor: 0.9
      joints: {".*": {kp: 80.0, kv: 4.0, effort_limit: 100.0}}
      init: {joint_pos: {".*_knee": 0.6, "(left|right)_pitch": -0.3, ".*_ankle_pitch": -0.3}}
commands:
  velocity: {func: uniform_velocity, resampling_time_s: [5.0, 10.0], lin_vel_x: [-1.0, 1.0], lin_vel_y: [-0.5, 0.5], ang_vel_z: [-1.0, 1.0], rel_standing: 0.1}
actions:
  joints: {func: joint_position, scale: 0.25}
observations:
  policy: &policy
    history: 5
    lin: {func: base_lin_vel, noise: {kind: uniform, low: -0.1, high: 0.1}}
    ang: {func: base_ang_vel, noise: {kind: uniform, low: -0.2, high: 0.2}}
    gravity: {func: projected_gravity, noise: {kind: uniform, low: -0.05, high: 0.05}}
    command: {func: generated_commands, command: velocity}
    pos: {func: joint_pos_rel, noise: {kind: uniform, low: -0.01, high: 0.01}}
    vel: {func: joint_vel_rel, scale: 0.05, noise: {kind: uniform, low: -1.5, high: 1.5}}
    action: {func: last_action}
  critic:
    history: 3
    lin: {func: base_lin_vel}
    ang: {func: base_ang_vel}
    gravity: {func: projected_gravity}
    command: {func: generated_commands, command: velocity}
    pos: {func: joint_pos_rel}
    vel: {func: joint_vel_rel, scale: 0.05}
    action: {func: last_action}
  estimator:
    history: 5
    ang: {func: base_ang_vel, noise: {kind: gaussian, std: 0.1}}
    gravity: {func: projected_gravity, noise: {kind: gaussian, std: 0.02}}
    pos: {func: joint_pos_rel, noise: {kind: gaussian, std: 0.005}}
events:
  friction: {func: randomize_geom_friction, mode: startup, geoms: ["(left|right)_foot"], range: [0.4, 1.2], operation: set}
  root: {func: reset_root_state_uniform, mode: reset, x: [-0.5, 0.5], y: [-0.5, 0.5], yaw: [-3.14, 3.14]}
  joints: {func: reset_joints_by_scale, mode: reset, position: [0.5, 1.5]}
  mass: {func: randomize_body_mass, mode: reset, bodies: [pelvis], range: [-1.0, 1.0], operation: add}
  push: {func: push_by_setting_velocity, mode: interval, interval_range_s: [5.0, 10.0], linear_velocity: [[-0.5, 0.5], [-0.5, 0.5], [0.0, 0.0]]}
rewards:
  track_lin: {func: track_lin_vel_xy_exp, weight: 1.0, command: velocity, std: 0.5}
  track_ang: {func: track_ang_vel_z_exp, weight: 0.5, command: velocity, std: 0.5}
  lin_z: {func: lin_vel_z_l2, weight: -2.0}
  ang_xy: {func: ang_vel_xy_l2, weight: -0.05}
  torques: {func: joint_torques_l2, weight: -1.0e-5}
  acc: {func: joint_acc_l2, weight: -2.5e-7}
  rate: {func: action_rate_l2, weight: -0.01}
  flat: {func: flat_orientation_l2, weight: -1.0}
  limits: {func: joint_pos_limits, weight: -1.0}
  deviation: {func: joint_deviation_l1, weight: -0.1, joints: [".*_arm_.*", "waist_.*"]}
  air: {func: feet_air_time, weight: 1.0, sensor: feet, command: velocity, threshold: 0.4}
  fell: {func: is_terminated, weight: -200.0}
terminations:
  time_out: {func: time_out, time_out: true}
  low: {func: root_height_below_minimum, minimum_height: 0.4}
  tilt: {func: bad_orientation, limit_angle: 1.0}
"""


def environment(folder: Path, num_envs: int) -> VecEnv:
    """The task, built."""
    (folder / "humanoid.xml").write_text(humanoid())
    (folder / "task.yaml").write_text(yaml.safe_dump(yaml.safe_load(TASK), sort_keys=False))  # without the anchor
    return make_env(resolve(find_task(str(folder)), overrides=[f"scene.num_envs={num_envs}"]))


def share_outside(env: VecEnv, steps: int, repeats: int) -> list[tuple[float, float, float]]:
    """(share of a step outside physics, physics ms, step ms), a row a repeat."""
    generator = torch.Generator().manual_seed(0)
    actions = [0.5 * torch.randn(env.num_envs, env.layout.action_size, generator=generator) for _ in range(8)]
    env.reset()
    for _ in range(50):  # until they fall and begin anew, a few at a time
        env.step(actions[0])
    rows = []
    for _ in range(repeats):
        physics, begin = env.seconds["physics"], time.perf_counter()
        for step in range(steps):
            env.step(actions[step % len(actions)])
        total = time.perf_counter() - begin
        physics = env.seconds["physics"] - physics
        rows.append((1.0 - physics / total, 1e3 * physics / steps, 1e3 * total / steps))
    return rows


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--num-envs", type=int, default=1024)
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        env = environment(Path(folder), options.num_envs)
        rows = share_outside(env, options.steps, options.repeats)
    share, physics, step = (statistics.median(column) for column in zip(*rows, strict=True))
    low, high = min(row[0] for row in rows), max(row[0] for row in rows)
    if options.json:
        record = {"machine": describe(), "share": share, "min": low, "max": high, "physics_ms": physics, "step_ms": step}
        print(json.dumps(record, indent=1))  # noqa: T201
        return
    print(describe())  # noqa: T201
    print(f"{options.num_envs} environments: {share:.1%} outside physics ({low:.1%} .. {high:.1%}),"  # noqa: T201
          f" physics {physics:.1f} ms of {step:.1f} ms")  # fmt: skip


if __name__ == "__main__":
    main()

"""Share of a manager-based task's step outside physics: `python benchmarks/humanoid.py`.

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
from machine import describe

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.envs.vec_env import VecEnv
from rlcli.registry import find_task


def limb(name: str, at: str, joints: list[tuple[str, str, str]], length: float, mass: float, end: str = "") -> str:
    """Chains with one link for each joint (name, axis, range in degrees); the last link is long."""
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


LEG = [
    ("yaw", "0 0 1", "-60 60"),
    ("roll", "1 0 0", "-30 30"),
    ("pitch", "0 1 0", "-120 45"),
    ("knee", "0 1 0", "0 140"),
    ("ankle_pitch", "0 1 0", "-50 40"),
    ("ankle_roll", "1 0 0", "-20 20"),
]
ARM = [
    ("shoulder_pitch", "0 1 0", "-170 150"),
    ("shoulder_roll", "1 0 0", "-90 90"),
    ("shoulder_yaw", "0 0 1", "-90 90"),
    ("elbow", "0 1 0", "-120 10"),
    ("wrist_roll", "1 0 0", "-90 90"),
    ("wrist_pitch", "0 1 0", "-80 80"),
    ("wrist_yaw", "0 0 1", "-80 80"),
]
WAIST = [("yaw", "0 0 1", "-80 80"), ("roll", "1 0 0", "-30 30"), ("pitch", "0 1 0", "-30 30")]
FOOT = '<geom name="{0}_foot" type="box" size="0.09 0.04 0.015" pos="0.03 0 -0.035" mass="0.4"/>'


def humanoid() -> str:
    """Return the MJCF of the robot."""
    legs = "".join(
        limb(side, f"0 {y} -0.08", LEG, 0.33, 6.0, FOOT.format(side)) for side, y in (("left", 0.1), ("right", -0.1))
    )
    arms = "".join(limb(f"{side}_arm", f"0 {y} 0.3", ARM, 0.2, 2.5) for side, y in (("left", 0.2), ("right", -0.2)))
    torso = '<geom type="box" size="0.08 0.12 0.18" pos="0 0 0.18" mass="12"/>' + arms
    waist = limb("waist", "0 0 0.08", WAIST, 0.02, 1.5, torso)
    return f"""
<mujoco model="humanoid29">
  <compiler angle="degree" autolimits="true"/>
  <option solver="Newton" iterations="10" ls_iterations="20"/>
  <default><joint damping="1" armature="0.02" frictionloss="0.1"/><geom friction="0.8 0.005 0.0001"/></default>
  <worldbody><body name="pelvis" pos="0 0 0.82"><freejoint name="root"/>
    <geom type="box" size="0.08 0.1 0.06" mass="5"/><site name="imu"/>{legs}{waist}
  </body></worldbody>
  <sensor><gyro name="gyro" site="imu"/><velocimeter name="velocity" site="imu"/></sensor>
</mujoco>
"""


TASK = Path(__file__).with_name("humanoid.yaml")


def environment(folder: Path, num_envs: int) -> VecEnv:
    """Return the environment."""
    (folder / "humanoid.xml").write_text(humanoid())
    (folder / "task.yaml").write_text(TASK.read_text())
    return make_env(resolve(find_task(str(folder)), overrides=[f"scene.num_envs={num_envs}"]))


def share_outside(env: VecEnv, steps: int, repeats: int) -> list[tuple[float, float, float]]:
    """Return (share of a step outside physics, physics ms, step ms) for each repeat."""
    generator = torch.Generator().manual_seed(0)
    actions = [0.5 * torch.randn(env.num_envs, env.layout.action_size, generator=generator) for _ in range(8)]
    env.reset()
    for _ in range(50):  # until a few of them fall and are reset in each step
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
        record = {
            "machine": describe(),
            "share": share,
            "min": low,
            "max": high,
            "physics_ms": physics,
            "step_ms": step,
        }
        print(json.dumps(record, indent=1))
        return
    print(describe())
    print(f"{options.num_envs} environments: {share:.1%} outside physics ({low:.1%} .. {high:.1%}),"
          f" physics {physics:.1f} ms of {step:.1f} ms")  # fmt: skip


if __name__ == "__main__":
    main()

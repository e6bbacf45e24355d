"""Check that `gpu_mjlab.py` is the same task as ours: both step the same states under the same actions on a CPU.

    python benchmarks/gpu_mdp_check.py --peer-path FOLDER[:FOLDER]

Some states are beyond the cart's bounds, some actions beyond the actuator's limit, and some ages beyond the time-out.
The precision of the physics differs (float64 in rlcli, float32 in mjlab); observations and rewards differ by less than
1e-4.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.registry import find_task

TOLERANCE = 1e-4
START = np.array([1.0, 0.785398163, 0.5, 0.785398163])  # x, theta, x', theta': half the widths of the reset


def draw_states(batches: int, num_envs: int, steps: int) -> dict[str, np.ndarray]:
    """Return the start states and actions of `steps` steps."""
    rng = np.random.default_rng(0)
    shape = (batches, num_envs)
    return {
        "qpos": rng.uniform([-3.3, -4.0], [3.3, 4.0], (*shape, 2)).astype(np.float32),
        "qvel": rng.uniform(-3.0, 3.0, (*shape, 2)).astype(np.float32),
        "age": rng.integers(280, 300, shape),
        "action": rng.normal(0.0, 3.0, (batches, steps, num_envs, 1)).astype(np.float32),
    }


def our_steps(states: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the steps on rlcli's CPU engine. (steps, num_envs, ...) each"""
    env = make_env(resolve(find_task("cartpole"), flags={"scene.num_envs": states["qpos"].shape[1]}), seed=0)
    rows: dict[str, list[torch.Tensor]] = {"obs": [], "reward": [], "terminated": [], "truncated": []}
    for batch, actions in enumerate(states["action"]):
        env.reset()
        for field in ("qpos", "qvel"):
            env.engine.field(field)[:] = torch.as_tensor(states[field][batch])
        env.episode_length_buf[:] = torch.as_tensor(states["age"][batch])
        for action in torch.as_tensor(actions):
            step = env.step(action)
            for name, row in rows.items():
                row.append((step.obs["policy"] if name == "obs" else getattr(step, name)).clone())
    return {name: torch.stack(row).numpy() for name, row in rows.items()}


def peer_steps(states: dict[str, np.ndarray], path: str) -> dict[str, np.ndarray]:
    """Return the same steps on mjlab, in a process with its packages, and the `start` of each of its episodes."""
    script = Path(__file__).with_name("gpu_mjlab.py")
    with tempfile.TemporaryDirectory() as folder:
        given, taken = Path(folder, "states.npz"), Path(folder, "steps.npz")
        np.savez(given, **states)
        command = [sys.executable, script, "trace", "--device", "cpu", "--states", given, "--output", taken]
        done = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True)
        if done.returncode:
            sys.exit(f"{done.stderr}\n{script.name} failed with --peer-path {path}")
        return dict(np.load(taken))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--peer-path", required=True, help="PYTHONPATH of mjlab's packages")
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--batches", type=int, default=16)
    parser.add_argument("--steps", type=int, default=5, help="from each state")
    options = parser.parse_args()
    states = draw_states(options.batches, options.num_envs, options.steps)
    ours, peers = our_steps(states), peer_steps(states, options.peer_path)

    # after its first end an environment is wherever its reset has put it
    ended = (ours["terminated"] | ours["truncated"]).reshape(options.batches, options.steps, options.num_envs)
    before = (np.cumsum(ended, axis=1) - ended).reshape(-1, options.num_envs) == 0
    going = before & ~(ours["terminated"] | ours["truncated"])
    start = np.abs(peers["start"]).reshape(-1, 4) / START
    report = {
        "steps": int(before.sum()),
        "terminated": int((ours["terminated"] & before).sum()),
        "truncated": int((ours["truncated"] & before).sum()),
        "saturated": int(((np.abs(states["action"]) > 4.0).reshape(*before.shape) & before).sum()),
        "reward_difference": float(np.abs(ours["reward"] - peers["reward"])[before].max()),
        "observation_difference": float(np.abs(ours["obs"] - peers["obs"])[going].max()),
        "ends_that_differ": int(((ours["terminated"] != peers["terminated"]) & before).sum())
        + int(((ours["truncated"] != peers["truncated"]) & before).sum()),
        # of a uniform distribution: 1 and 0.5
        "peer_start_max": start.max(axis=0).tolist(),
        "peer_start_mean": start.mean(axis=0).tolist(),
    }
    print(json.dumps(report))
    agree = (
        report["ends_that_differ"] == 0
        and max(report["reward_difference"], report["observation_difference"]) < TOLERANCE
        and bool((start.max(axis=0) <= 1.0 + 1e-6).all())
        and bool((np.abs(start.mean(axis=0) - 0.5) < 0.03).all())
    )
    if not agree:
        sys.exit("the two tasks differ")


if __name__ == "__main__":
    main()

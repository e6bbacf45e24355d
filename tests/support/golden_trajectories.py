"""Recorded trajectories of the built-in tasks, and the command that records them again.

`python tests/support/golden_trajectories.py` from the repository's root rewrites them: after a change that is meant to
give other numbers, and never otherwise. The commit says why.
"""

from __future__ import annotations

import hashlib
import json
import os
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.envs.vec_env import VecEnv
from rlcli.machine.processor import processor
from rlcli.registry import find_task

FILE = Path(__file__).with_name("golden_trajectories.json")
TASKS = ("ant-direct", "cartpole", "cartpole-direct")
SEEDS = (0, 1)
NUM_ENVS, STEPS, CLOSE_STEPS, EVERY = 4, 500, 100, 25
TOLERANCE = 1e-9
"""Allowed deviation of joint positions and velocities on other machines, for CLOSE_STEPS steps."""


def machine() -> dict[str, str]:
    """Return the properties of the machine that change the bits of a trajectory."""
    versions = {name: metadata.version(name) for name in ("mujoco", "torch", "numpy")}
    libc = os.confstr("CS_GNU_LIBC_VERSION") if hasattr(os, "confstr") else None
    return {**versions, "libc": libc or "", "kernels": processor()["kernels"]}


def trajectory(task: str, seed: int) -> dict[str, Any]:
    """Return the hash of a trajectory, and its states at some of the first steps."""
    torch.set_num_threads(1)
    env = make_env(resolve(find_task(task), overrides=[f"scene.num_envs={NUM_ENVS}"]), seed=seed)
    digest = hashlib.sha256()
    observations = env.reset()
    states = [_state(env)]
    for step in range(1, STEPS + 1):
        result = env.step(_action(env, step))
        for value in (*observations.values(), result.reward, result.terminated, result.truncated):
            digest.update(value.contiguous().numpy().tobytes())
        observations = result.obs
        if step <= CLOSE_STEPS and step % EVERY == 0:
            states.append(_state(env))
    return {"sha256": digest.hexdigest(), "states": states}


def recorded() -> dict[str, Any]:
    """Return the content of the file."""
    return json.loads(FILE.read_text(encoding="utf-8"))


def furthest(states: list[list[float]], others: list[list[float]]) -> float:
    """Return the largest deviation between two lists of states."""
    return max(abs(a - b) for row, twin in zip(states, others, strict=True) for a, b in zip(row, twin, strict=True))


def _action(env: VecEnv, step: int) -> torch.Tensor:
    """Return actions in multiples of 1/64, from arithmetic that is exact on every machine."""
    size = env.layout.action_size
    numbers = (torch.arange(NUM_ENVS * size) * 7919 + step * 104729) % 129 - 64
    return (numbers.float() / 64).reshape(NUM_ENVS, size)


def _state(env: VecEnv) -> list[float]:
    return [*env.engine.field("qpos").flatten().tolist(), *env.engine.field("qvel").flatten().tolist()]


def main() -> None:
    found = {task: {str(seed): trajectory(task, seed) for seed in SEEDS} for task in TASKS}
    FILE.write_text(json.dumps({"machine": machine(), "tasks": found}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

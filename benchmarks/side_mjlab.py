"""mjlab's side (see sides.py): the cartpole of `gpu_mjlab.py` on its CPU device."""

from __future__ import annotations

from typing import Any

import gpu_mjlab
from machine import memory_mb
from sides import clock, serve

theirs: dict[str, Any] = {}


def version() -> dict[str, Any]:
    """Return the versions of mjlab and its dependencies."""
    import argparse

    return gpu_mjlab.version(argparse.Namespace(device="cpu"), 0)


def open_env(num_envs: int, threads: int) -> None:
    """Make the environment, with episodes that start at random ages, and random actions."""
    import torch

    gpu_mjlab._prepare()
    torch.set_num_threads(threads)
    environment = gpu_mjlab.make_env(num_envs, "cpu", 0)
    environment.reset()
    ages = environment.episode_length_buf
    environment.episode_length_buf = torch.randint_like(ages, int(environment.max_episode_length))
    theirs.update(env=environment, actions=torch.rand(16, num_envs, 1) * 2.0 - 1.0)


def step(steps: int) -> float:
    """Return the seconds of `steps` environment steps."""
    import torch

    environment, actions = theirs["env"], theirs["actions"]
    begin = clock()
    with torch.inference_mode():
        for index in range(steps):
            environment.step(actions[index % 16])
    return clock() - begin


if __name__ == "__main__":
    serve({f.__name__: f for f in (version, open_env, step, memory_mb)})

"""Trajectories as hashes, one per environment, and the plain MuJoCo loop that must give the same."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import torch

from rlcli.envs.vec_env import VecEnv
from support.fault_sizes import amount
from support.worlds import CRITTER_TASK, actions, build, critter, edited

TASKS = ["cartpole", "cartpole-direct", "ant-direct", "critter"]
"""The built-in tasks, and one with contacts, commands, noise and models that differ between environments."""
STEPS, ENVS = amount(60, 200), amount(8, 64)
_STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_EVENTS = {
    "mass": {"func": "randomize_body_mass", "mode": "reset", "range": [0.5, 1.5]},
    "friction": {"func": "randomize_geom_friction", "mode": "startup", "range": [0.5, 1.5]},
    "root": {"func": "reset_root_state_uniform", "mode": "reset", "x": [-0.5, 0.5], "roll": [-0.2, 0.2]},
    "push": {"func": "push_by_setting_velocity", "mode": "interval", "interval_range_s": [0.1, 0.3],
             "linear_velocity": [[-1.0, 1.0], [-1.0, 1.0], [0.0, 0.0]]},
    "hit": {"func": "apply_body_impulse", "mode": "interval", "interval_range_s": [0.1, 0.2], "bodies": "torso",
            "force": [-5.0, 5.0], "duration_s": [0.02, 0.1]},
}  # fmt: skip
_COMMANDS = {"velocity": {"func": "uniform_velocity", "resampling_time_s": [0.1, 0.3], "lin_vel_x": [-1.0, 1.0]}}
_NOISY = {
    "policy": {
        "command": {"func": "generated_commands", "command": "velocity"},
        "vel": {"func": "joint_vel_rel", "noise": {"kind": "gaussian", "std": 0.1}},
        "pos": {"func": "joint_pos_rel", "noise": {"kind": "uniform", "low": -0.1, "high": 0.1}},
        "ang": {"func": "base_ang_vel"},
    }
}


def make(task: str, folder: Path, num_envs: int, threads: int = 1, seed: int = 42) -> VecEnv:
    """Return an environment with short episodes, so that trajectories include resets."""
    place = place_of(task, folder)
    return build(place, num_envs, f"sim.engine_threads={threads}", "episode_length_s=0.6", seed=seed)


def place_of(task: str, folder: Path) -> Path | str:
    """Return the task's name on the command line; the critter is written to a folder."""
    if task != "critter":
        return task
    return critter(folder, edited(CRITTER_TASK, events=_EVENTS, commands=_COMMANDS, observations=_NOISY))


class HashedRollout:
    """Running trajectory: hashes of every environment's states, observations, rewards and dones."""

    def __init__(self, env: VecEnv, seed: int = 0, steps: int = STEPS) -> None:
        self.env = env
        self._hashes = [hashlib.sha256() for _ in range(env.num_envs)]
        self._actions = iter(actions(steps, env.num_envs, env.layout.action_size, seed))
        self.ends = 0
        self._take(env.reset(), [])

    def step(self) -> None:
        result = self.env.step(next(self._actions))
        self.ends += int((result.terminated | result.truncated).sum())
        self._take(result.obs, [result.reward, result.terminated, result.truncated])

    def hashes(self) -> list[str]:
        return [each.hexdigest() for each in self._hashes]

    def _take(self, obs: dict[str, torch.Tensor], rest: list[torch.Tensor]) -> None:
        values = [self.env.engine.state_dict()["state"], *obs.values(), *rest]
        rows = [np.ascontiguousarray(value.numpy()) for value in values]
        for index, digest in enumerate(self._hashes):
            for row in rows:
                digest.update(row[index].tobytes())


def rollout_hashes(env: VecEnv, seed: int = 0, steps: int = STEPS) -> list[str]:
    """Return one hash per environment of the whole trajectory."""
    rollout = HashedRollout(env, seed, steps)
    for _ in range(steps):
        rollout.step()
    return rollout.hashes()


def against_plain_steps(env: VecEnv) -> list[int]:
    """Repeat every engine step with `mj_step` in each environment. Return the list of steps that differ."""
    differing: list[int] = []
    models: dict[int, mujoco.MjModel] = {}
    batch, data, whole = env.engine._batch, mujoco.MjData(env.engine.model), env.engine.step
    count = 0

    def step(nstep: int, **how: bool) -> None:
        nonlocal count
        before = batch.state.copy()
        whole(nstep, **how)
        after = np.empty_like(before[0])
        for world in range(env.num_envs):
            model = env.engine.model
            if batch._expanded:
                if world not in models:
                    models[world] = batch.get_model(world)
                model = models[world]
                batch.get_model(world, model)
            mujoco.mj_setState(model, data, before[world], _STATE)
            for _ in range(nstep):
                mujoco.mj_step(model, data)
            mujoco.mj_getState(model, data, after, _STATE)
            if after.tobytes() != batch.state[world].tobytes():
                differing.append(count)
        count += 1

    env.engine.step = step
    return differing


def other_work() -> dict[str, Callable[[], object]]:
    """Return other uses of torch in the same process, by name."""
    return {
        "draws": lambda: (torch.rand(1000), np.random.rand(10), random.random()),
        "seeds": lambda: (torch.manual_seed(7), np.random.seed(7), random.seed(7)),
        "products": lambda: torch.randn(257, 129) @ torch.randn(129, 63),
        "learning": _learn,
        "threads": lambda: torch.set_num_threads(2),
    }


def _learn() -> None:
    network = torch.nn.Linear(8, 8)
    optimizer = torch.optim.Adam(network.parameters())
    for _ in range(3):
        network(torch.randn(33, 8)).square().mean().backward()
        optimizer.step()

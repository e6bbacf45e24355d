"""Environment step compared with the bare physics of the same model: `python benchmarks/env_step.py`.

Both are timed in turn in one process, block by block. The figure is the median of the ratios of neighbouring blocks.
It may be above 1.00: the engine skips work that has no effect (`rlcli/sim/skippable_work.py`), and an unmodified
`mujoco.batch.Batch` does not. `physics` is the engine's share of a step; the rest is for actions, observations,
rewards, terminations, resets and episode sums.

The bare physics starts from the environments' states with their controls, and is reset to them before the two differ
much. `of bare Batch` computes the stage that the task's terms read, `of stage NONE` computes none.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import torch
from machine import describe
from mujoco.batch import Batch

from rlcli.config.load import resolve
from rlcli.envs.sharding.training_env import make_training_env
from rlcli.envs.vec_env import VecEnv
from rlcli.registry import find_task

NONE = int(mujoco.mjtStage.mjSTAGE_NONE)
TASKS = [
    "ant",
    "ant-direct",
    "ball-balance",
    "biped-velocity",
    "cart-double-pendulum",
    "cartpole",
    "cartpole-direct",
    "crazyflie",
    "hand-reorient",
    "humanoid",
    "humanoid-direct",
    "ingenuity",
    "lift-cube",
    "open-drawer",
    "quadcopter",
    "quadruped-flat",
    "quadruped-rough",
    "reach",
    "reach-ik",
]
"""All built-in tasks but cartpole-camera, which renders pictures."""


def bare_block(
    batch: Batch, controls: Sequence[np.ndarray] | np.ndarray, substeps: int, steps: int, stage: int = NONE
) -> float:
    """Return the seconds of `steps` bare steps; the controls are written as in the environment."""
    ctrl = batch.bind("ctrl")
    begin = time.perf_counter()
    for step in range(steps):
        ctrl[:] = controls[step % len(controls)]
        batch.step(nstep=substeps, stage=stage)
    return time.perf_counter() - begin


@dataclass(frozen=True, slots=True)
class Bare:
    """Physics alone, from the environments' states and with their controls."""

    batch: Batch
    start: np.ndarray
    """(num_envs, nstate)"""
    controls: list[np.ndarray]
    """Controls of each step. (num_envs, nu) each"""
    substeps: int

    def block(self, steps: int, stage: int) -> float:
        """Return the seconds of `steps` bare steps."""
        seconds = 0.0
        for first in range(0, steps, len(self.controls)):
            self.batch.state[:] = self.start
            several = min(len(self.controls), steps - first)
            seconds += bare_block(self.batch, self.controls, self.substeps, several, stage)
        return seconds


def bare_of(env: VecEnv, actions: torch.Tensor) -> Bare:
    """Return the physics of an environment in its current state, with the controls of its next steps."""
    start = env.engine.state_rows(np.arange(env.num_envs))
    controls = []
    for action in actions:
        env.step(action)
        controls.append(env.engine.field("ctrl").numpy().copy())
    batch = Batch(env.engine.model, env.num_envs, env.engine.threads)
    return Bare(batch, start, controls, env.config.decimation)


def env_block(env: VecEnv, actions: torch.Tensor, steps: int) -> float:
    """Return the seconds of `steps` environment steps."""
    begin = time.perf_counter()
    with torch.inference_mode():
        for step in range(steps):
            env.step(actions[step % len(actions)])
    return time.perf_counter() - begin


def measure(
    task: str, num_envs: int, repeats: int, seconds: float, workers: int | str = "auto"
) -> dict[str, float | int | str]:
    """Return one row of the table."""
    resolved = resolve(find_task(task), flags={"scene.num_envs": num_envs, "scene.workers": workers})
    env = make_training_env(resolved, seed=0, device="cpu")
    env.final_obs_of = "truncated"  # what a trainer asks for
    env.reset(seed=0)
    generator = torch.Generator().manual_seed(0)
    actions = torch.rand(16, num_envs, env.layout.action_size, generator=generator) * 2.0 - 1.0
    # episodes of different ages, as after a long time
    env.episode_length_buf.copy_(torch.randint(0, env.max_episode_length, (num_envs,), generator=generator))
    env_block(env, actions, 48)
    bare_physics, stage = bare_of(env, actions), env.engine.step_stage
    steps = max(16, int(seconds / (bare_physics.block(16, stage) / 16)))
    ratios, without, shares, rates, bares = [], [], [], [], []
    for _ in range(repeats):
        bare = bare_physics.block(steps, stage)
        before = env.seconds["physics"]
        full = env_block(env, actions, steps)
        shares.append((env.seconds["physics"] - before) / full)
        ratios.append(bare / full)
        without.append((bare_physics.block(steps, NONE) if stage != NONE else bare) / full)
        rates.append(steps * num_envs / full)
        bares.append(steps * num_envs / bare)
    env.close()
    return {
        "task": task,
        "num_envs": num_envs,
        "workers": env.workers,
        "ratio": statistics.median(ratios),
        "ratio_min": min(ratios),
        "ratio_max": max(ratios),
        "ratio_stage_none": statistics.median(without),
        "physics": statistics.median(shares),
        "env_steps_per_s": statistics.median(rates),
        "bare_steps_per_s": statistics.median(bares),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--num-envs", nargs="+", type=int, default=[64, 1024, 4096])
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=0.5, help="length of a block")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--workers", nargs="+", default=["auto"], help="processes that step environments")
    options = parser.parse_args()
    torch.set_num_threads(1)
    cases = [(task, n, workers) for task in options.tasks for n in options.num_envs for workers in options.workers]
    rows = []
    for task, n, workers in cases:
        count = workers if workers == "auto" else int(workers)
        rows.append(measure(task, n, options.repeats, options.seconds, count))
    if options.json:
        print(json.dumps({"machine": describe(), "rows": rows}, indent=2))
        return
    print(describe())
    print(f"{'task':18}{'envs':>6}{'workers':>8}{'of bare Batch':>15}{'min .. max':>16}", end="")
    print(f"{'of stage NONE':>15}{'physics':>9}{'env steps/s':>14}{'bare':>12}")
    for row in rows:
        spread = f"{row['ratio_min']:.3f} .. {row['ratio_max']:.3f}"
        rates = f"{row['physics']:>9.3f}{row['env_steps_per_s']:>14,.0f}{row['bare_steps_per_s']:>12,.0f}"
        print(
            f"{row['task']:18}{row['num_envs']:>6}{row['workers']:>8}{row['ratio']:>15.3f}{spread:>16}{row['ratio_stage_none']:>15.3f}{rates}"
        )
    for n in options.num_envs:
        ratios = {row["task"]: row["ratio"] for row in rows if row["num_envs"] == n}
        worst = min(ratios, key=lambda task: ratios[task])
        mean = statistics.geometric_mean(ratios.values())
        print(f"{n} environments: geometric mean {mean:.3f}, lowest {ratios[worst]:.3f} ({worst})")


if __name__ == "__main__":
    main()

"""Training speed as a share of the bare physics: `python benchmarks/train.py`.

PPO with the sizes of the field's cartpole (4,096 environments x 16 steps, 5 epochs, 4 minibatches, two networks of
32-32 ELU) against `mujoco.batch.Batch.step` of the same model, in turn in one process; beside it stock
Stable-Baselines3 on the same environment through its plain VecEnv interface. Medians of the ratios.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time

import numpy as np
import torch
from env_step import bare_block
from machine import describe
from mujoco.batch import Batch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger

from rlcli.adapters.sb3 import Sb3VecEnv
from rlcli.config.load import resolve
from rlcli.envs.vec_env import make_env
from rlcli.machine import available_cores
from rlcli.registry import find_task
from rlcli.rl.sb3 import Sb3Trainer

SIZES = ["agent.n_steps=16", "agent.n_epochs=5", "agent.num_minibatches=4"]


def fast_block(trainer: Sb3Trainer) -> tuple[float, dict[str, float]]:
    """Seconds of one iteration, and its parts."""
    begin = time.perf_counter()
    report = trainer.iterate()
    return time.perf_counter() - begin, report.seconds


def stock_block(model: PPO) -> float:
    """Seconds of one iteration of SB3's own loop."""
    begin = time.perf_counter()
    model.learn(model.n_steps * model.n_envs, reset_num_timesteps=False)
    return time.perf_counter() - begin


def stock_model(num_envs: int) -> PPO:
    """SB3's PPO as it comes, on the same task with the same sizes."""
    env = make_env(resolve(find_task("cartpole"), flags={"scene.num_envs": num_envs}), seed=0)
    model = PPO(
        "MlpPolicy",
        Sb3VecEnv(env, 1.0),
        n_steps=16,
        batch_size=16 * num_envs // 4,
        n_epochs=5,
        policy_kwargs={"net_arch": {"pi": [32, 32], "vf": [32, 32]}, "activation_fn": torch.nn.ELU},
        device="cpu",
    )
    model.set_logger(Logger(folder=None, output_formats=[]))
    return model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--num-envs", nargs="+", type=int, default=[512, 4096])
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    threads = available_cores()
    rows = []
    for num_envs in options.num_envs:
        resolved = resolve(find_task("cartpole"), overrides=SIZES, flags={"scene.num_envs": num_envs})
        env = make_env(resolved, seed=0)
        trainer = Sb3Trainer(env, resolved.agent, seed=0, device="cpu", torch_threads=min(4, threads))
        trainer.start()
        stock = stock_model(num_envs)
        batch = Batch(env.engine.model, num_envs, threads)
        controls = np.random.default_rng(0).uniform(-100.0, 100.0, (16, num_envs, 1))
        for _ in range(3):
            trainer.iterate()
            stock_block(stock)
        fast, plain, rates, parts = [], [], [], []
        for _ in range(options.repeats):
            bare = bare_block(batch, controls, env.config.decimation, 16)
            seconds, split = fast_block(trainer)
            torch.set_num_threads(min(4, threads))
            plain.append(bare / stock_block(stock))
            batch.reset()
            fast.append(bare / seconds)
            rates.append(16 * num_envs / seconds)
            parts.append(split)
        rows.append(
            {
                "num_envs": num_envs,
                "ratio": statistics.median(fast),
                "ratio_min": min(fast),
                "ratio_max": max(fast),
                "stock_sb3_ratio": statistics.median(plain),
                "train_steps_per_s": statistics.median(rates),
                "ms": {name: 1e3 * statistics.median(p[name] for p in parts) for name in parts[0]},
            }
        )
    if options.json:
        print(json.dumps({"machine": describe(), "rows": rows}, indent=2))
        return
    print(describe())
    print(f"{'envs':>6}{'of bare Batch':>15}{'min .. max':>16}{'stock SB3':>11}{'steps/s':>11}   ms an iteration")
    for row in rows:
        spread = f"{row['ratio_min']:.3f} .. {row['ratio_max']:.3f}"
        split = "  ".join(f"{name} {value:.0f}" for name, value in row["ms"].items())
        figures = f"{row['stock_sb3_ratio']:>11.3f}{row['train_steps_per_s']:>11,.0f}"
        print(f"{row['num_envs']:>6}{row['ratio']:>15.3f}{spread:>16}{figures}   {split}")


if __name__ == "__main__":
    main()

"""Training speed relative to the bare physics: `python benchmarks/train.py`.

PPO with the usual sizes for a cartpole (4,096 environments x 16 steps, 5 epochs, 4 minibatches, two networks of 32-32
ELU) is compared with `mujoco.batch.Batch.step` of the same model, in turn in one process: the built-in trainer `ppo`,
the trainer `sb3`, and unmodified Stable-Baselines3 on the same environment through its VecEnv interface. Figures are
medians of the ratios.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from typing import Any

import numpy as np
import torch
from env_step import bare_block
from machine import describe
from mujoco.batch import Batch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger

from rlcli.adapters.sb3 import Sb3VecEnv
from rlcli.config.load import resolve
from rlcli.envs.make import make_env
from rlcli.machine.cores import available_cores
from rlcli.registry import find_task
from rlcli.rl.ppo.trainer import PpoTrainer
from rlcli.rl.sb3.trainer import Sb3Trainer

SIZES = {
    "ppo": ["agent.num_steps=16", "agent.num_epochs=5", "agent.num_minibatches=4"],
    "sb3-ppo": ["agent.n_steps=16", "agent.n_epochs=5", "agent.num_minibatches=4"],
}
TRAINERS: dict[str, Any] = {"ppo": PpoTrainer, "sb3-ppo": Sb3Trainer}
STOCK = "stock SB3"


def trainer_of(agent: str, num_envs: int, threads: int) -> Any:
    """Return one of rlcli's trainers on the common cartpole, after its first iterations."""
    flags = {"scene.num_envs": num_envs}
    resolved = resolve(find_task("cartpole"), agent=agent, overrides=SIZES[agent], flags=flags)
    trainer = TRAINERS[agent](
        make_env(resolved, seed=0), resolved.agent, seed=0, device="cpu", torch_threads=min(4, threads)
    )
    trainer.start()
    for _ in range(3):
        trainer.iterate()
    return trainer


def own_block(trainer: PpoTrainer | Sb3Trainer) -> tuple[float, dict[str, float]]:
    """Return the seconds of one iteration and of its parts."""
    begin = time.perf_counter()
    report = trainer.iterate()
    return time.perf_counter() - begin, report.seconds


def stock_block(model: PPO) -> float:
    """Return the seconds of one iteration of SB3's own loop."""
    begin = time.perf_counter()
    model.learn(model.n_steps * model.n_envs, reset_num_timesteps=False)
    return time.perf_counter() - begin


def stock_model(num_envs: int) -> PPO:
    """Return unmodified SB3 PPO on the same task with the same sizes."""
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


def measure(num_envs: int, repeats: int) -> list[dict[str, Any]]:
    """Return the rows of one number of environments: bare physics, then an iteration of each trainer, in turn."""
    threads = available_cores()
    trainers = {agent: trainer_of(agent, num_envs, threads) for agent in SIZES}
    stock = stock_model(num_envs)
    env = trainers["ppo"].env
    batch = Batch(env.engine.model, num_envs, threads)
    controls = np.random.default_rng(0).uniform(-100.0, 100.0, (16, num_envs, 1))
    for _ in range(3):
        stock_block(stock)
    ratios: dict[str, list[float]] = {name: [] for name in (*trainers, STOCK)}
    rates: dict[str, list[float]] = {name: [] for name in ratios}
    parts: dict[str, list[dict[str, float]]] = {name: [] for name in trainers}
    for _ in range(repeats):
        bare = bare_block(batch, controls, env.config.decimation, 16)
        batch.reset()
        for name in ratios:
            if name == STOCK:
                torch.set_num_threads(min(4, threads))
                seconds = stock_block(stock)
            else:
                seconds, split = own_block(trainers[name])
                parts[name].append(split)
            ratios[name].append(bare / seconds)
            rates[name].append(16 * num_envs / seconds)
    return [
        {
            "trainer": name,
            "num_envs": num_envs,
            "ratio": statistics.median(found),
            "ratio_min": min(found),
            "ratio_max": max(found),
            "train_steps_per_s": statistics.median(rates[name]),
            "ms": {
                part: 1e3 * statistics.median(split[part] for split in parts[name])
                for part in (parts[name][0] if name in parts else ())
            },
        }
        for name, found in ratios.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--num-envs", nargs="+", type=int, default=[512, 4096])
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = [row for num_envs in options.num_envs for row in measure(num_envs, options.repeats)]
    if options.json:
        print(json.dumps({"machine": describe(), "rows": rows}, indent=2))
        return
    print(describe())
    print(f"{'trainer':10}{'envs':>6}{'of bare Batch':>15}{'min .. max':>16}{'steps/s':>11}   ms an iteration")
    for row in rows:
        spread = f"{row['ratio_min']:.3f} .. {row['ratio_max']:.3f}"
        split = "  ".join(f"{name} {value:.0f}" for name, value in row["ms"].items())
        figures = f"{row['ratio']:>15.3f}{spread:>16}{row['train_steps_per_s']:>11,.0f}"
        print(f"{row['trainer']:10}{row['num_envs']:>6}{figures}   {split}")


if __name__ == "__main__":
    main()

"""Other libraries' PPO (see sides.py): Stable-Baselines3 on a plain Gymnasium cartpole, RSL-RL and skrl on rlcli's.

Sizes and hyper-parameters are the same everywhere: 16 steps, 5 epochs, 4 minibatches, two networks of 32-32 ELU.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import metadata
from typing import Any

import torch
from machine import cores
from sides import clock, serve

STEPS, EPOCHS, MINIBATCHES = 16, 5, 4
opened: dict[str, Any] = {}


def version() -> dict[str, str]:
    """Return the versions of the libraries."""
    return {name: metadata.version(name) for name in ("stable-baselines3", "rsl-rl-lib", "skrl", "gymnasium")}


def open_sb3(kind: str, num_envs: int) -> None:
    """Make SB3's PPO with a `DummyVecEnv` or a `SubprocVecEnv` of plain cartpoles."""
    from plain_cartpole import PlainCartpole
    from stable_baselines3 import PPO
    from stable_baselines3.common.logger import Logger
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    close()
    make = [PlainCartpole] * num_envs
    # forked: hundreds of processes that each import torch would not fit into memory
    env = DummyVecEnv(make) if kind == "dummy" else SubprocVecEnv(make, start_method="fork")
    torch.set_num_threads(min(4, cores()))
    model = PPO(
        "MlpPolicy",
        env,
        learning_rate=1e-3,
        n_steps=STEPS,
        batch_size=STEPS * num_envs // MINIBATCHES,
        n_epochs=EPOCHS,
        ent_coef=0.005,
        vf_coef=1.0,
        clip_range_vf=0.2,
        max_grad_norm=1.0,
        policy_kwargs={"net_arch": {"pi": [32, 32], "vf": [32, 32]}, "activation_fn": torch.nn.ELU},
        device="cpu",
    )
    model.set_logger(Logger(folder=None, output_formats=[]))

    def iterate() -> None:
        model.learn(STEPS * num_envs, reset_num_timesteps=False)

    opened.update(iterate=iterate, close=env.close)


def open_rsl_rl(num_envs: int) -> None:
    """Make RSL-RL's own runner on rlcli's environment."""
    from rsl_rl.runners import OnPolicyRunner

    from rlcli.adapters.rsl_rl import RslRlVecEnv

    close()
    env = cartpole(num_envs)
    network = {"class_name": "MLPModel", "hidden_dims": [32, 32], "activation": "elu"}
    gaussian = {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "scalar"}
    settings = {
        "num_steps_per_env": STEPS,
        "save_interval": 10**9,
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "actor": {**network, "distribution_cfg": gaussian},
        "critic": network,
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": EPOCHS,
            "num_mini_batches": MINIBATCHES,
            "learning_rate": 1e-3,
            "schedule": "adaptive",
            "desired_kl": 0.01,
            "gamma": 0.99,
            "lam": 0.95,
            "clip_param": 0.2,
            "use_clipped_value_loss": True,
            "value_loss_coef": 1.0,
            "entropy_coef": 0.005,
            "max_grad_norm": 1.0,
        },
    }
    torch.set_num_threads(min(4, cores()))
    runner = OnPolicyRunner(RslRlVecEnv(env), settings, None, "cpu")
    opened.update(iterate=lambda: runner.learn(1), close=env.close)


def open_skrl(num_envs: int) -> None:
    """Make skrl's PPO on rlcli's environment, through a wrapper."""
    from skrl_cartpole import trainer

    close()
    env = cartpole(num_envs)
    torch.set_num_threads(min(4, cores()))
    opened.update(iterate=trainer(env, STEPS, EPOCHS, MINIBATCHES), close=env.close)


def train(steps: int) -> float:
    """Return the seconds of `iterations` iterations."""
    iterate: Callable[[], None] = opened["iterate"]
    begin = clock()
    for _ in range(steps):
        iterate()
    return clock() - begin


def close() -> None:
    """Close everything that was opened."""
    if "close" in opened:
        opened["close"]()
    opened.clear()


def cartpole(num_envs: int) -> Any:
    """Return rlcli's cartpole."""
    from rlcli.config.load import resolve
    from rlcli.envs.make import make_env
    from rlcli.registry import find_task

    env = make_env(resolve(find_task("cartpole"), flags={"scene.num_envs": num_envs}), seed=0)
    env.final_obs_of = "truncated"
    return env


if __name__ == "__main__":
    serve({f.__name__: f for f in (version, open_sb3, open_rsl_rl, open_skrl, train, close)})

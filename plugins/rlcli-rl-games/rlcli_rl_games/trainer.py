"""Trainers that run rl_games' PPO and SAC one iteration at a time, with exact save and restore."""

from __future__ import annotations

from rlcli.envs.environment import Environment
from rlcli_rl_games.base import RlGamesTrainer
from rlcli_rl_games.config import RlGamesConfig, SacConfig
from rlcli_rl_games.ppo import PpoTrainer
from rlcli_rl_games.sac import SacTrainer


def make_trainer(
    env: Environment, config: RlGamesConfig, *, seed: int, device: str, torch_threads: int
) -> RlGamesTrainer:
    """Return the trainer of an agent."""
    trainer = SacTrainer if isinstance(config, SacConfig) else PpoTrainer
    return trainer(env, config, seed=seed, device=device, torch_threads=torch_threads)

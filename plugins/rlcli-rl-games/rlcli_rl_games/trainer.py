"""Choice of the trainer, PPO or SAC, for an agent of rl_games."""

from __future__ import annotations

from rlcli.envs.environment_protocol import Environment
from rlcli_rl_games.base import RlGamesTrainer
from rlcli_rl_games.config import RlGamesConfig, SacConfig
from rlcli_rl_games.ppo import PpoTrainer
from rlcli_rl_games.sac import SacTrainer


def make_trainer(
    env: Environment, config: RlGamesConfig, *, seed: int, device: str, torch_threads: int
) -> RlGamesTrainer:
    """Return the trainer for an agent's algorithm."""
    trainer = SacTrainer if isinstance(config, SacConfig) else PpoTrainer
    return trainer(env, config, seed=seed, device=device, torch_threads=torch_threads)

"""`make_trainer`, which makes the PPO or SAC trainer for an agent's settings."""

from __future__ import annotations

from rlcli.envs.environment_protocol import Environment
from rlcli_rl_games.base import RlGamesTrainer
from rlcli_rl_games.config import RlGamesConfig, SacConfig
from rlcli_rl_games.ppo import PpoTrainer
from rlcli_rl_games.sac import SacTrainer


def make_trainer(
    env: Environment, config: RlGamesConfig, *, seed: int, device: str, torch_threads: int
) -> RlGamesTrainer:
    """Return a `PpoTrainer` or `SacTrainer`, by the type of the agent's settings."""
    trainer = SacTrainer if isinstance(config, SacConfig) else PpoTrainer
    return trainer(env, config, seed=seed, device=device, torch_threads=torch_threads)

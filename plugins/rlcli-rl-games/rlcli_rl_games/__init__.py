"""Plugin with the trainer `rl-games`: PPO and SAC of the library rl_games."""

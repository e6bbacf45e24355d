"""Plugin with the trainer `rsl-rl`: PPO of the library RSL-RL."""

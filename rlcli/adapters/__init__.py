"""Adapters that give a `VecEnv` the interface of Gymnasium, Stable-Baselines3 or RSL-RL."""

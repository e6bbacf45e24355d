"""Adapters that give a `VecEnv` the interface of Gymnasium, Stable-Baselines3 or RSL-RL.

Each adapter serves one learning library, whose own scripts can then train in a task of rlcli.
"""

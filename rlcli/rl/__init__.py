"""Policies, neural networks, and the trainers `ppo` (built in) and `sb3` (Stable-Baselines3).

The training loop in `rlcli.training` calls a trainer; evaluations and viewers call policies.
"""

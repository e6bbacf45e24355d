"""Adapters that give rlcli's environments the interface of Gymnasium, Stable-Baselines3 or RSL-RL.

With an adapter, training scripts of these libraries can use a task of rlcli.
"""

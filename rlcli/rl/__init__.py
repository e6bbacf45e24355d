"""Policies, networks, and the trainers `ppo` and `sb3`."""

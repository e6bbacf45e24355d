"""The learning side of rlcli: policies, networks, and the trainers `ppo` (built in) and `sb3` (Stable-Baselines3)."""

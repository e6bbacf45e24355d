"""The trainer `sb3`, which trains with the algorithms of Stable-Baselines3 (PPO, A2C, SAC, TD3, DDPG).

The updates are those of Stable-Baselines3; rollouts are stored as torch tensors, without copies to numpy.
"""

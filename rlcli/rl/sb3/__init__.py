"""The trainer `sb3`, which trains with the algorithms of Stable-Baselines3 (PPO, A2C, SAC, TD3, DDPG).

Rollouts stay in torch; the updates are those of Stable-Baselines3.
"""

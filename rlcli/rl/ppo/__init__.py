"""The built-in PPO trainer: configuration, collector of rollouts, learner, networks.

`trainer.PpoTrainer` combines them.
"""

"""The built-in trainer `ppo`: settings, collection of rollouts, loss and gradient, networks.

`trainer.PpoTrainer` combines these modules.
"""

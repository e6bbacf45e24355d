"""Training: the trainer protocol, runs and checkpoints, rollouts and evaluation."""

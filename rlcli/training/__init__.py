"""Run a training: setup, loop, checkpoints, evaluations, health checks, metric loggers and signals."""

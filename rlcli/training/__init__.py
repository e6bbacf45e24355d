"""Training: from a configuration or a saved run to finished checkpoints."""

"""The folder of a run (one training): its checkpoints, configuration and metrics, and comparisons of runs."""

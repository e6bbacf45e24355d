"""Modules that write, read and compare the folders of runs; a run is one training, with checkpoints and metrics."""

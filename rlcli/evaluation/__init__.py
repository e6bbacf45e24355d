"""Evaluation of policies: statistics of episodes, limits, comparisons, stress tests, a reference controller (LQR)."""

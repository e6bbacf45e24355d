"""Evaluation of policies: episodes and their statistics, limits, comparisons, stress tests, and a regulator (LQR)."""

"""Evaluation of policies: sessions, limits, comparisons, stress tests and a known regulator."""

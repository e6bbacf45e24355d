"""Evaluation of policies: statistics of episodes, limits, comparisons, stress tests, and LQR as a reference policy."""

"""Environments: the environment loop and its two workflows, managed and direct."""

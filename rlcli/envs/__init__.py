"""Environments: the environment loop and its two workflows, manager-based and direct."""

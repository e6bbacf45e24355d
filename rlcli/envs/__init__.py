"""Environments: one step loop, and the two workflows that fill it."""

"""Managers: one MDP concern each, made of terms that are bound once, when the environment is built."""

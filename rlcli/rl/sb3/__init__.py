"""Stable-Baselines3's algorithms as trainers."""

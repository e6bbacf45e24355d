"""Policies, networks and trainers."""

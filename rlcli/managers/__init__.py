"""Managers of manager-based tasks. Each calls the terms of one section of the task's YAML file."""

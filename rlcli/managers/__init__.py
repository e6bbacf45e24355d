"""Managers of manager-based tasks. Each calls the terms (functions and classes) of one section of the YAML."""
